import array
import dataclasses

import numpy as np
import pytest
from adapters.clouds import F4, F8, STAMP, U1, U4, check_track_columns, cloud, live, make_tracks, track_columns
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2, PointField

from msg_adapters import track_table
from msg_adapters.arrays import MessageError, TrackArrays
from msg_adapters.track_table import track_table_from_msg, track_table_to_msg
from track_fusion.tracks import StateLayout, TrackBatch

AXES = ("x", "y", "z", "vx", "vy", "vz", "yaw", "turn_rate", "gyro_bias_x", "b")


def reason(msg: PointCloud2) -> tuple[str, str]:
    with pytest.raises(MessageError) as error:
        track_table_from_msg(msg)
    return error.value.reason, str(error.value)


@st.composite
def any_tracks(draw: st.DrawFn) -> TrackArrays:
    axes = tuple(draw(st.lists(st.sampled_from(AXES), min_size=1, max_size=6, unique=True)))
    count, components = draw(st.integers(0, 5)), draw(st.integers(1, 4))
    tracks = make_tracks(count, components, axes, seed=draw(st.integers(0, 99)))
    if draw(st.booleans()):
        tracks = dataclasses.replace(tracks, uuid=np.arange(16 * count, dtype=np.uint8).reshape(count, 16))
    if draw(st.booleans()):
        tracks = dataclasses.replace(tracks, dof=np.where(np.arange(count) % 2, np.inf, 4.5))
    padding = draw(st.lists(st.booleans(), min_size=components, max_size=components))
    weight = np.where(padding, 0.0, tracks.weight)
    weight[:, 0] = np.where(weight.any(1), weight[:, 0], 1.0)
    return dataclasses.replace(tracks, weight=weight, phd=draw(st.booleans()))


@given(any_tracks())
def test_every_table_comes_back_to_the_last_bit(tracks: TrackArrays) -> None:
    msg = track_table_to_msg(tracks, tracks.axes, STAMP)
    back = track_table_from_msg(deserialize_message(serialize_message(msg), PointCloud2))
    assert (back.axes, back.frame_id, back.phd) == (tracks.axes, "map", tracks.phd)
    for name in ("track_id", "source", "status", "existence", "time_ns", "dof"):
        np.testing.assert_array_equal(getattr(back, name), getattr(tracks, name))
        assert getattr(back, name).dtype == getattr(TrackBatch.empty(StateLayout(("x",)), "map"), name).dtype
    assert (back.uuid is None) == (tracks.uuid is None)
    if tracks.uuid is not None:
        np.testing.assert_array_equal(back.uuid, tracks.uuid)
    assert msg.width == (tracks.weight != 0).sum()
    symmetric = dataclasses.replace(tracks, cov=np.triu(tracks.cov) + np.triu(tracks.cov, 1).swapaxes(-1, -2))
    for k in range(len(tracks.track_id)):
        assert live(back, k) == live(symmetric, k)


def test_what_is_read_is_ready_for_the_library() -> None:
    tracks = make_tracks(4, 3, weight=np.array([[1, 0, 0], [0.5, 0.5, 0], [0.2, 0.3, 0.5], [0, 1, 0]]))
    back = track_table_from_msg(track_table_to_msg(tracks, tracks.axes, STAMP))
    arrays = {f.name: getattr(back, f.name) for f in dataclasses.fields(back) if f.name != "axes"}
    batch, rejected = TrackBatch.screened(layout=StateLayout(back.axes), **arrays)
    assert not rejected
    assert len(batch) == 4
    again = track_table_from_msg(track_table_to_msg(batch, batch.layout.axes, STAMP))
    np.testing.assert_array_equal(again.mean, back.mean)
    assert all(a.flags.c_contiguous for a in (back.mean, back.cov))


def test_what_is_read_does_not_change_with_the_message() -> None:
    tracks = make_tracks(1, uuid=np.arange(16, dtype=np.uint8)[None], dof=np.array([5.0]))
    msg = track_table_to_msg(tracks, tracks.axes, STAMP)
    back = track_table_from_msg(msg)
    for i in range(len(msg.data)):
        msg.data[i] = 0xFF
    np.testing.assert_array_equal(back.mean, tracks.mean)
    for name in ("cov", "weight", "track_id", "status", "source", "existence", "uuid", "dof"):
        np.testing.assert_allclose(getattr(back, name), getattr(tracks, name), rtol=1e-12)


def test_messages_pass_the_field_checks_and_are_aligned() -> None:
    msg = track_table_to_msg(make_tracks(2, uuid=np.zeros((2, 16), np.uint8)), ("x", "y", "vx", "vy"), STAMP)
    assert msg._check_fields, "ROS_PYTHON_CHECK_FIELDS must be 1 before messages are imported"
    assert isinstance(msg.data, array.array)
    names = [f.name for f in msg.fields]
    assert names == ["track_id", "uuid", "status", "source", "existence", "weight", "x", "y", "vx", "vy",
                     "cov_x_x", "cov_x_y", "cov_x_vx", "cov_x_vy", "cov_y_y", "cov_y_vx", "cov_y_vy", "cov_vx_vx",
                     "cov_vx_vy", "cov_vy_vy"]  # fmt: skip
    assert [(f.datatype, f.count) for f in msg.fields[:5]] == [(U4, 1), (U1, 16), (U1, 1), (U4, 1), (F8, 1)]
    assert all(f.offset % 8 == 0 for f in msg.fields if f.datatype == F8)
    assert msg.point_step % 8 == 0


def test_optional_fields_are_written_only_when_they_say_something() -> None:
    def names(tracks: TrackArrays) -> set[str]:
        return {f.name for f in track_table_to_msg(tracks, tracks.axes, STAMP).fields} & {"dof", "uuid", "phd"}

    assert names(make_tracks(2)) == set()
    assert names(make_tracks(2, dof=np.array([np.inf, 5.0]))) == {"dof"}
    assert names(make_tracks(2, uuid=np.zeros((2, 16), np.uint8))) == {"uuid"}
    assert names(make_tracks(2, phd=True)) == {"phd"}


def test_an_empty_scan_has_stamp_frame_and_fields() -> None:
    msg = track_table_to_msg(make_tracks(0), ("x", "y", "vx", "vy"), STAMP)
    assert (msg.width, msg.height, len(msg.data)) == (0, 1, 0)
    back = track_table_from_msg(msg)
    assert back.mean.shape == (0, 1, 4)
    assert back.cov.shape == (0, 1, 4, 4)
    assert (msg.header.stamp.sec, msg.header.stamp.nanosec) == divmod(STAMP, 10**9)


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize("gap", [0, 3])
@pytest.mark.parametrize(("height", "padding"), [(1, 0), (2, 0), (2, 5), (4, 8)])
def test_clouds_of_other_writers(big_endian: bool, gap: int, height: int, padding: int) -> None:
    msg = cloud(track_columns(), big_endian=big_endian, gap=gap, height=height, row_padding=padding)
    check_track_columns(track_table_from_msg(msg))


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize(("height", "padding"), [(1, 0), (2, 0), (2, 8), (4, 8), (2, 3)])
@pytest.mark.parametrize(
    ("before", "after", "doubles_at", "step"),
    [(U4, None, 0, 0), (None, None, 4, 4), (None, U4, 4, 0), (U4, U1, 0, 1)],
)
def test_aligned_and_half_aligned_clouds_of_other_writers(
    big_endian: bool, height: int, padding: int, before: int | None, after: int | None, doubles_at: int, step: int
) -> None:
    own = track_columns(status=(U4, [1, 0, 0, 3]))
    columns = [*own[:3], *([("spare", before, [9] * 4)] if before else []), *own[3:]]
    columns += [("last", after, [9] * 4)] if after else []
    msg = cloud(columns, big_endian=big_endian, height=height, row_padding=padding)
    assert {f.offset % 8 for f in msg.fields if f.datatype == F8} == {doubles_at}
    assert msg.point_step % 8 == step
    check_track_columns(track_table_from_msg(msg))


def test_any_numeric_datatype_and_any_field_order() -> None:
    changes = {
        "track_id": (PointField.INT16, [7, 9, 9, 8]), "source": (F8, [3.0, 1.0, 1.0, float(0x80000000)]),
        "status": (F4, [1.0, 0.0, 0.0, 3.0]), "x": (PointField.INT8, [1, 2, 3, 4]),
        "cov_x_y": (F4, [0.1, 0.2, 0.3, 0.4]), "existence": (F4, [1.0, 0.5, 0.5, 0.25]),
    }  # fmt: skip
    msg = cloud(track_columns(**changes))
    check_track_columns(track_table_from_msg(msg))
    first = [c for c in track_columns(**changes) if c[0] in ("x", "y")]
    rest = [c for c in reversed(track_columns(**changes)) if c[0] not in ("x", "y")]
    check_track_columns(track_table_from_msg(cloud(first + rest)))


def test_covariance_names_may_stand_either_way_round() -> None:
    msg = cloud(track_columns(cov_x_y=None, cov_y_x=(F8, [0.1, 0.2, 0.3, 0.4])))
    check_track_columns(track_table_from_msg(msg))


def test_unknown_fields_of_any_kind_are_ignored() -> None:
    extra = [("rgb", F4, [(1.0, 2.0, 3.0)] * 4), ("cov_q_q", F8, [5.0] * 4), ("intensity", U1, [1, 2, 3, 4])]
    msg = cloud([extra[0], *track_columns(), *extra[1:]])
    msg.fields.append(PointField(name="strange", offset=9999, datatype=77, count=0))
    check_track_columns(track_table_from_msg(msg))


def test_nan_and_infinity_pass_through() -> None:
    values = [np.nan, np.inf, -np.inf, 0.0]
    back = track_table_from_msg(cloud(track_columns(x=(F8, values), cov_x_y=(F8, values), track_id=(U4, [1, 2, 3, 4]))))
    np.testing.assert_array_equal(back.mean[:, 0, 0], values)
    np.testing.assert_array_equal(back.cov[:, 0, 1, 0], values)
    same = track_table_from_msg(cloud(track_columns(existence=(F8, [1.0, np.nan, np.nan, 0.0]))))
    np.testing.assert_array_equal(same.existence, [1.0, np.nan, 0.0])


def test_an_id_that_comes_back_is_a_second_entry() -> None:
    back = track_table_from_msg(cloud(track_columns(track_id=(U4, [7, 9, 9, 7]))))
    assert back.track_id.tolist() == [7, 9, 7]


def test_a_negative_id_is_left_to_the_library() -> None:
    back = track_table_from_msg(cloud(track_columns(track_id=(PointField.INT32, [-1, 9, 9, 8]))))
    assert back.track_id.tolist() == [-1, 9, 8]


@pytest.mark.parametrize(
    "name", ["track_id", "status", "source", "existence", "weight", "cov_x_y"],
)  # fmt: skip
@pytest.mark.parametrize("rows", [4, 0])
def test_a_missing_field_is_named(name: str, rows: int) -> None:
    key, text = reason(cloud(track_columns(**{name: None}), rows=rows))
    assert key == "missing_field"
    assert f"must have the fields {name}" in text


def test_a_cloud_without_axes() -> None:
    key, text = reason(cloud(track_columns(cov_x_x=None, cov_y_y=None)))
    assert key == "missing_field"
    assert "axis" in text


def test_an_axis_is_what_has_a_variance() -> None:
    assert track_table_from_msg(cloud(track_columns(cov_y_y=None))).axes == ("x",)


def test_status_is_never_an_axis() -> None:
    assert track_table_from_msg(cloud(track_columns(cov_status_status=(F8, [1.0] * 4)))).axes == ("x", "y")


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"x": (F8, [(1.0, 2.0)] * 4)}, "'x' must have the count 1. Got 2"),
        ({"track_id": (U4, [(1, 2)] * 4)}, "'track_id' must have the count 1. Got 2"),
        ({"uuid": (U1, [(1,) * 8] * 4)}, "'uuid' must have the count 16. Got 8"),
        ({"uuid": (F4, [(1.0,) * 16] * 4)}, "'uuid' must be 16 UINT8"),
        ({"track_id": (F8, [7.5, 9.0, 9.0, 8.0])}, "'track_id' must hold integers (u4). Got 7.5"),
        ({"track_id": (F8, [np.nan, 9.0, 9.0, 8.0])}, "'track_id' must hold integers (u4). Got nan"),
        ({"status": (U4, [1, 0, 0, 256])}, "'status' must hold integers (u1). Got 256"),
        ({"source": (PointField.INT32, [1, 0, 0, -1])}, "'source' must hold integers (u4). Got -1"),
    ],
)
def test_bad_fields(changes: dict[str, object], text: str) -> None:
    key, got = reason(cloud(track_columns(**changes)))
    assert key == "bad_field"
    assert text in got


def test_a_datatype_that_does_not_exist_and_a_count_of_zero() -> None:
    msg = cloud(track_columns())
    msg.fields[5].datatype = 9
    assert reason(msg) == ("bad_field", "The field 'x' must have a datatype from 1 to 8. Got 9.")
    msg.fields[5].datatype, msg.fields[5].count = F8, 0
    assert reason(msg) == ("bad_field", "The field 'x' must have the count 1. Got 0.")


def test_a_field_given_twice() -> None:
    assert reason(cloud([*track_columns(), ("x", F8, [0.0] * 4)]))[0] == "bad_field"


def test_one_name_for_two_covariances() -> None:
    names = ("a", "b_c", "a_b", "c")
    pairs = {f"cov_{a}_{b}": (F8, [1.0] * 4) for i, a in enumerate(names) for b in names[i:]}
    columns = {n: (F8, [1.0] * 4) for n in names} | pairs
    assert len(pairs) == 9  # not 10: cov_a_b_c
    assert reason(cloud(track_columns(x=None, y=None, **columns)))[0] == "bad_field"


@pytest.mark.parametrize(
    "change",
    [
        lambda m: m.data.pop(),
        lambda m: m.data.append(0),
        lambda m: setattr(m, "data", array.array("B")),
        lambda m: setattr(m, "width", m.width + 1),
        lambda m: setattr(m, "height", 2),
        lambda m: setattr(m, "height", 0),
        lambda m: (setattr(m, "height", 2), setattr(m, "row_step", m.row_step // 2)),
        lambda m: setattr(m, "row_step", 0),
        lambda m: (setattr(m, "row_step", m.row_step + 8), m.data.extend([0] * 8)),
        lambda m: setattr(m, "point_step", m.point_step - 1),
        lambda m: setattr(m.fields[9], "offset", m.point_step - 7),
        lambda m: setattr(m, "point_step", 0),
    ],
)
def test_lengths_that_do_not_fit(change: object) -> None:
    msg = cloud(track_columns())
    change(msg)  # type: ignore[operator]
    assert reason(msg)[0] == "wrong_data_length"


def test_a_step_of_zero_without_rows_does_not_hold_the_fields() -> None:
    msg = cloud(track_columns(), rows=0)
    msg.point_step = 0
    assert reason(msg)[0] == "wrong_data_length"


@pytest.mark.parametrize(
    ("name", "column"),
    [
        ("status", (U1, [1, 0, 1, 3])),
        ("source", (U4, [3, 1, 2, 0])),
        ("existence", (F8, [1.0, 0.5, 0.6, 0.25])),
        ("existence", (F8, [1.0, 0.5, np.nan, 0.25])),
        ("dof", (F8, [np.inf, 5.0, np.inf, 4.0])),
        ("uuid", (U1, [(0,) * 16, (1,) * 16, (1,) * 15 + (2,), (0,) * 16])),
    ],
)
def test_rows_of_one_track_that_disagree(name: str, column: object) -> None:
    key, text = reason(cloud(track_columns(**{name: column})))
    assert key == "inconsistent_rows"
    assert f"'{name}'" in text
    assert "track 9" in text


def test_phd_is_one_for_all() -> None:
    assert track_table_from_msg(cloud(track_columns(phd=(U1, [1] * 4)))).phd
    assert not track_table_from_msg(cloud(track_columns(phd=(U1, [0] * 4)))).phd
    assert reason(cloud(track_columns(phd=(U1, [1, 1, 1, 0]))))[0] == "inconsistent_rows"


def test_ragged_tables_do_not_fill_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(track_table, "MAX_PADDED_COMPONENTS", 5)
    assert reason(cloud(track_columns()))[0] == "too_ragged"  # 3 tracks of 2 components
    monkeypatch.setattr(track_table, "MAX_PADDED_COMPONENTS", 6)
    check_track_columns(track_table_from_msg(cloud(track_columns())))


def test_plans_are_not_mixed_up_and_not_kept_for_ever() -> None:
    for spare in range(2 * track_table.PLANS):
        check_track_columns(track_table_from_msg(cloud([*track_columns(), (f"spare_{spare}", U1, [0] * 4)])))
    assert track_table._plan.cache_info().currsize <= track_table.PLANS


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"time_ns": np.array([STAMP, STAMP + 1])}, f"Got {STAMP + 1} for track 1"),
        ({"track_id": np.array([3, 3])}, "must be unique"),
        ({"track_id": np.array([3, -1])}, "Got -1 to 3"),
        ({"track_id": np.array([3, 2**32])}, f"Got 3 to {2**32}"),
    ],
)
def test_what_cannot_be_written(fields: dict[str, np.ndarray], text: str) -> None:
    tracks = make_tracks(2, **{"track_id": np.array([0, 1]), **fields})
    with pytest.raises(ValueError, match=text):
        track_table_to_msg(tracks, tracks.axes, STAMP)


@pytest.mark.parametrize(
    "axes",
    [("x", "x"), ("x", ""), ("x", "status"), ("x", "cov_x_x"), ("a", "b_c", "a_b", "c"), (),
     ("a", "b", "cov_a", "b_cov_a_b")],
)  # fmt: skip
def test_axis_names_that_a_reader_could_not_tell_apart(axes: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match="axes must"):
        track_table_to_msg(make_tracks(1, axes=axes or ("x",)), axes, STAMP)


def test_the_number_of_axes_must_fit() -> None:
    with pytest.raises(ValueError, match="must have 2 axes.*Got 4"):
        track_table_to_msg(make_tracks(1), ("x", "y"), STAMP)


def test_a_track_without_any_weight_does_not_vanish() -> None:
    tracks = make_tracks(2, 2, weight=np.array([[0.0, 0.0], [0.5, 0.5]]))
    back = track_table_from_msg(track_table_to_msg(tracks, tracks.axes, STAMP))
    assert back.track_id.tolist() == tracks.track_id.tolist()
    assert back.weight.tolist() == [[0.0, 0.0], [0.5, 0.5]]
