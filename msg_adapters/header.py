"""Headers: stamps as integer nanoseconds, and the checks that every input passes first."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msg_adapters.arrays import MessageError
from msg_adapters.classes import Classes, message_class

if TYPE_CHECKING:
    from builtin_interfaces.msg import Time
    from std_msgs.msg import Header

NS_PER_S = 1_000_000_000
#: The seconds of a builtin_interfaces/Time are an int32.
MAX_STAMP_NS = 2**31 * NS_PER_S - 1
MIN_STAMP_NS = -(2**31) * NS_PER_S


def stamp_to_ns(stamp: Time) -> int:
    """Return a stamp as nanoseconds since the epoch; exact (floats of epoch seconds lose 0.2 us)."""
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def stamp_from_ns(time_ns: int, classes: Classes = message_class) -> Time:
    """Return nanoseconds since the epoch as a stamp.

    Raises
    ------
    ValueError    beyond the 32-bit seconds of a stamp (years 1901 to 2038)
    """
    time_ns = int(time_ns)
    if not MIN_STAMP_NS <= time_ns <= MAX_STAMP_NS:
        raise ValueError(f"A stamp must lie between {MIN_STAMP_NS} and {MAX_STAMP_NS} ns. Got {time_ns}.")
    sec, nanosec = divmod(time_ns, NS_PER_S)
    return classes("builtin_interfaces/msg/Time")(sec=sec, nanosec=nanosec)


def make_header(stamp_ns: int, frame_id: str, classes: Classes = message_class) -> Header:
    """Make a header from nanoseconds and a frame."""
    return classes("std_msgs/msg/Header")(stamp=stamp_from_ns(stamp_ns, classes), frame_id=str(frame_id))


def check_header(header: Header, *, frame_id: str | None, now_ns: int, max_future_ns: int) -> int:
    """Check frame and stamp of an input, and return its stamp in nanoseconds.

    Parameters
    ----------
    header : std_msgs/Header
    frame_id : str or None    the frame that is wanted, compared to the letter (tf2 knows no leading "/");
                              None takes any frame that has a name, for callers who transform afterwards
    now_ns : int              the node's clock; 0 before the first /clock message of simulated time
    max_future_ns : int       how far ahead of `now_ns` a stamp may be: clocks of two machines differ a little

    Returns
    -------
    int    nanoseconds since the epoch

    Raises
    ------
    MessageError    `wrong_frame` (an empty one included); `zero_stamp`, nobody stamped it, when the clock
                    is past 0; `future_stamp`
    """
    if not header.frame_id or frame_id not in (None, header.frame_id):
        wanted = "a named frame" if frame_id is None else f"'{frame_id}'"
        raise MessageError("wrong_frame", f"The frame_id of the header must be {wanted}. Got '{header.frame_id}'.")
    stamp_ns = stamp_to_ns(header.stamp)
    if stamp_ns == 0 and now_ns > 0:
        raise MessageError("zero_stamp", f"The stamp of the header must be set: the clock is at {now_ns} ns. Got 0.")
    if stamp_ns - now_ns > max_future_ns:
        raise MessageError(
            "future_stamp",
            f"The stamp of the header must be at most {max_future_ns} ns ahead of the clock, {now_ns} ns. "
            f"Got {stamp_ns} ns, {stamp_ns - now_ns} ns ahead.",
        )
    return stamp_ns
