import numpy as np
import pytest
from adapters.clouds import F4, F8, STAMP, U1, cloud
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2

from msg_adapters.arrays import DetectionArrays, MessageError
from msg_adapters.detection_table import detection_table_from_msg, detection_table_to_msg

AXES = ("x", "y", "z", "range", "bearing", "range_rate")


@given(
    st.lists(st.sampled_from(AXES), min_size=1, max_size=5, unique=True), st.integers(0, 6), st.booleans(),
    st.integers(0, 99),
)  # fmt: skip
def test_every_table_comes_back_to_the_last_bit(axes: list[str], count: int, with_cov: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(count, len(axes), len(axes)))
    cov = root + root.swapaxes(-1, -2)
    sent = DetectionArrays(
        tuple(axes), "radar", STAMP, rng.normal(size=(count, len(axes))), cov if with_cov else None
    )  # fmt: skip
    msg = deserialize_message(serialize_message(detection_table_to_msg(sent)), PointCloud2)
    back = detection_table_from_msg(msg, axes)
    assert (back.axes, back.frame_id, back.time_ns) == (tuple(axes), "radar", STAMP)
    np.testing.assert_array_equal(back.value, sent.value)
    assert (back.cov is None) == (not with_cov)
    if with_cov:
        np.testing.assert_array_equal(back.cov, cov)
    reverse = detection_table_from_msg(msg, axes[::-1])
    np.testing.assert_array_equal(reverse.value, sent.value[:, ::-1])
    if with_cov:
        np.testing.assert_array_equal(reverse.cov, cov[:, ::-1, ::-1])


COLUMNS = [
    ("ring", U1, [1, 2]), ("bearing", F4, [0.5, -0.25]), ("range", F8, [50.0, 60.0]),
    ("cov_range_range", F8, [4.0, 9.0]), ("cov_bearing_range", F8, [0.1, 0.2]), ("cov_bearing_bearing", F8, [1.0, 2.0]),
]  # fmt: skip


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize(("height", "padding"), [(1, 0), (2, 0), (2, 3)])
def test_clouds_of_other_writers(big_endian: bool, height: int, padding: int) -> None:
    msg = cloud(COLUMNS, big_endian=big_endian, height=height, row_padding=padding)
    back = detection_table_from_msg(msg, ("range", "bearing"))
    assert back.value.tolist() == [[50.0, 0.5], [60.0, -0.25]]
    assert back.cov is not None
    assert back.cov.tolist() == [[[4.0, 0.1], [0.1, 1.0]], [[9.0, 0.2], [0.2, 2.0]]]


def test_a_lidar_cloud_will_do() -> None:
    columns = [("x", F4, [1.5, 2.5]), ("y", F4, [3.5, 4.5]), ("z", F4, [0.0, 0.0]), ("intensity", F4, [9.0, 9.0])]
    back = detection_table_from_msg(cloud(columns), ("x", "y"))
    assert back.value.tolist() == [[1.5, 3.5], [2.5, 4.5]]
    assert back.cov is None


def test_a_covariance_of_other_axes_is_none_of_ours() -> None:
    msg = cloud([("x", F8, [1.0]), ("y", F8, [2.0]), ("cov_y_y", F8, [3.0])])
    assert detection_table_from_msg(msg, ("x",)).cov is None


@pytest.mark.parametrize(
    ("gone", "axes", "text"),
    [
        ("range", ("range", "bearing"), "must have the fields range of a detection table"),
        ("cov_range_range", ("range", "bearing"), "must have the fields cov_range_range (covariance"),
        ("cov_bearing_range", ("range", "bearing"), "must have the fields cov_range_bearing (covariance"),
    ],
)
@pytest.mark.parametrize("rows", [0, 2])
def test_a_missing_field_is_named(gone: str, axes: tuple[str, ...], text: str, rows: int) -> None:
    with pytest.raises(MessageError) as error:
        detection_table_from_msg(cloud([c for c in COLUMNS if c[0] != gone], rows=rows), axes)
    assert error.value.reason == "missing_field"
    assert text in str(error.value)


def test_data_that_do_not_fit() -> None:
    msg = cloud(COLUMNS)
    msg.data.pop()
    with pytest.raises(MessageError) as error:
        detection_table_from_msg(msg, ("range",))
    assert error.value.reason == "wrong_data_length"


@pytest.mark.parametrize(
    ("value", "cov"), [(np.zeros((2, 3)), None), (np.zeros(2), None), (np.zeros((2, 2)), np.zeros((2, 2)))]
)
def test_shapes_that_do_not_fit(value: np.ndarray, cov: np.ndarray | None) -> None:
    with pytest.raises(ValueError, match=r"must have shape \(N, 2\)"):
        detection_table_to_msg(DetectionArrays(("x", "y"), "map", STAMP, value, cov))
