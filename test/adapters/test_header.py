import pytest
from builtin_interfaces.msg import Time
from std_msgs.msg import Header

from msg_adapters.arrays import MessageError
from msg_adapters.header import check_header, make_header, stamp_from_ns, stamp_to_ns

NOW = 1_700_000_000_123_456_789


@pytest.mark.parametrize(
    ("ns", "sec", "nanosec"),
    [(0, 0, 0), (NOW, 1_700_000_000, 123_456_789), (-1, -1, 999_999_999), (2**31 * 10**9 - 1, 2**31 - 1, 999_999_999)],
)
def test_stamps_are_exact_to_the_nanosecond(ns: int, sec: int, nanosec: int) -> None:
    assert stamp_from_ns(ns) == Time(sec=sec, nanosec=nanosec)
    assert stamp_to_ns(Time(sec=sec, nanosec=nanosec)) == ns


@pytest.mark.parametrize("ns", [2**31 * 10**9, -(2**31) * 10**9 - 1])
def test_stamps_beyond_32_bit_seconds_are_refused(ns: int) -> None:
    with pytest.raises(ValueError, match=f"Got {ns}"):
        stamp_from_ns(ns)


def test_a_good_header_gives_its_stamp() -> None:
    assert check_header(make_header(NOW, "map"), frame_id="map", now_ns=NOW, max_future_ns=0) == NOW
    assert check_header(make_header(NOW, "any"), frame_id=None, now_ns=NOW, max_future_ns=0) == NOW


@pytest.mark.parametrize(
    ("stamp", "frame", "wanted", "now", "reason", "text"),
    [
        (NOW, "odom", "map", NOW, "wrong_frame", "must be 'map'. Got 'odom'"),
        (NOW, "", "map", NOW, "wrong_frame", "must be 'map'. Got ''"),
        (NOW, "", "", NOW, "wrong_frame", "Got ''"),
        (NOW, "", None, NOW, "wrong_frame", "must be a named frame. Got ''"),
        (NOW, "/map", "map", NOW, "wrong_frame", "must be 'map'. Got '/map'"),
        (0, "map", "map", 1, "zero_stamp", "Got 0"),
        (NOW + 101, "map", "map", NOW, "future_stamp", f"at most 100 ns ahead of the clock, {NOW} ns. Got {NOW + 101}"),
    ],
)
def test_bad_headers_give_their_reason(
    stamp: int, frame: str, wanted: str | None, now: int, reason: str, text: str
) -> None:
    with pytest.raises(MessageError) as error:
        check_header(make_header(stamp, frame), frame_id=wanted, now_ns=now, max_future_ns=100)
    assert error.value.reason == reason
    assert text in str(error.value)


def test_a_zero_stamp_is_right_while_simulated_time_stands_at_zero() -> None:
    assert check_header(Header(frame_id="map"), frame_id="map", now_ns=0, max_future_ns=0) == 0


def test_the_future_limit_itself_is_allowed() -> None:
    assert check_header(make_header(NOW + 100, "map"), frame_id="map", now_ns=NOW, max_future_ns=100) == NOW + 100
