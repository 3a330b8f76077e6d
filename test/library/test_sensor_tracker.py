"""A sensor's own tracker: initialisation, detections, feedback."""

import numpy as np
import pytest

from track_fusion.filters.kalman import predict, update
from track_fusion.models.measurement import LinearSensor
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.params import ParameterError, Params
from track_fusion.sensor_tracker import SensorTracker, SensorTrackerParams
from track_fusion.track_filters import TRACK_FILTERS
from track_fusion.tracks import COASTED, CONFIRMED, StateLayout, TrackBatch, planar_layout

SECOND = 10**9
LAYOUT = planar_layout()
MOTION = NearlyConstantVelocity(LAYOUT, MotionParams(process_noise=2.0))
NOTHING = np.zeros((0, 2))


def tracker(layout=LAYOUT, sensor_sd=1.0, **params):
    motion, sensor = (
        NearlyConstantVelocity(layout, MotionParams(process_noise=2.0)),
        LinearSensor.position(layout, sensor_sd),
    )
    kalman = TRACK_FILTERS["kalman"].make(motion, sensor, Params())
    return SensorTracker(motion, sensor, kalman, "map", SensorTrackerParams(**params))


def known(**params):
    return tracker(initial_mean=(1.0, 2.0, 3.0, 4.0), initial_cov=(5.0, 6.0, 7.0, 8.0), sensor_sd=2.0, **params)


def fused_at(stamp, *means, cov=None, source=0, **fields):
    cov = np.tile(np.eye(4) if cov is None else cov, (len(means), 1, 1))
    return TrackBatch.gaussian(LAYOUT, "map", np.array(means, float), cov, time_ns=stamp, source=source, **fields)


def test_starts_from_the_initial_state_and_filters():
    found = known(initial_stamp_s=1.0, track_id=9).step(3 * SECOND, np.array([[7.0, 10.0]]), None)
    mean, cov = predict(np.array([1.0, 2.0, 3.0, 4.0]), np.diag([5.0, 6.0, 7.0, 8.0]), *MOTION.matrices(2.0))
    mean, cov, _ = update(mean, cov, np.array([7.0, 10.0]), np.eye(2, 4), 4.0 * np.eye(2))
    np.testing.assert_allclose(found.mean[0, 0], mean, rtol=1e-14)
    np.testing.assert_allclose(found.cov[0, 0], cov, rtol=1e-14)
    assert (found.time_ns.tolist(), found.track_id.tolist(), found.status.tolist()) == ([3 * SECOND], [9], [CONFIRMED])
    assert found.frame_id == "map"


def test_a_full_initial_covariance_is_read_row_by_row():
    rng = np.random.default_rng(0)
    a = rng.normal(size=(4, 4))
    cov = a @ a.T
    found = tracker(initial_mean=(0.0,) * 4, initial_cov=tuple(cov.ravel())).step(0, NOTHING, None)
    np.testing.assert_allclose(found.cov[0, 0], cov, rtol=1e-12)


@pytest.mark.parametrize("covs", [None, np.diag([1.0, 9.0])[None]])
def test_else_from_the_first_detection_wherever_the_axes_stand(covs):
    mixed = StateLayout(("vy", "y", "x", "vx"))
    own = tracker(mixed, sensor_sd=2.0, initial_speed_sd=5.0)
    assert len(own.step(0, NOTHING, None)) == 0
    assert own.time_ns == -1
    found = own.step(SECOND, np.array([[10.0, 20.0]]), covs)
    assert found.mean[0, 0].tolist() == [0.0, 20.0, 10.0, 0.0]
    x, y = (4.0, 4.0) if covs is None else (1.0, 9.0)
    np.testing.assert_array_equal(found.cov[0, 0], np.diag([25.0, y, x, 25.0]))
    assert (own.time_ns, found.status.tolist()) == (SECOND, [CONFIRMED])


def test_the_velocity_is_learnt_after_such_a_start():
    own = tracker(sensor_sd=0.1, initial_speed_sd=10.0)
    for k in range(20):
        found = own.step(k * SECOND, np.array([[3.0 * k, -2.0 * k]]), None)
    np.testing.assert_allclose(found.mean[0, 0, 2:], [3.0, -2.0], atol=1e-6)


def test_without_detection_it_coasts():
    own = known()
    found = own.step(2 * SECOND, NOTHING, None)
    np.testing.assert_allclose(found.mean[0, 0], [7.0, 10.0, 3.0, 4.0])
    assert found.status.tolist() == [CONFIRMED | COASTED]
    assert own.step(3 * SECOND, np.array([[10.0, 14.0]]), None).status.tolist() == [CONFIRMED]


def test_of_several_detections_the_statistically_nearest_is_taken():
    """The second is farther in metres, but its axis is vague."""
    own = tracker(initial_mean=(0.0,) * 4, initial_cov=(100.0, 0.01, 1.0, 1.0), sensor_sd=0.1)
    values = np.array([[0.0, 3.0], [8.0, 0.0], [900.0, 0.0]])
    alone = tracker(initial_mean=(0.0,) * 4, initial_cov=(100.0, 0.01, 1.0, 1.0), sensor_sd=0.1)
    found, wanted = own.step(0, values, None), alone.step(0, values[1:2], None)
    np.testing.assert_allclose(found.mean, wanted.mean)
    # Its own covariance makes the third the nearest: it says next to nothing.
    covs = np.stack([0.01 * np.eye(2), 0.01 * np.eye(2), 1e12 * np.eye(2)])
    other = tracker(initial_mean=(0.0,) * 4, initial_cov=(100.0, 0.01, 1.0, 1.0))
    np.testing.assert_allclose(other.step(0, values, covs).mean, 0.0, atol=1e-6)


def test_feedback_replaces_the_state_of_its_time():
    own = known()
    before = own.step(SECOND, np.array([[4.0, 6.0]]), None)
    cov = np.diag([1.0, 2.0, 3.0, 4.0])
    assert own.feed_back(fused_at(SECOND, [9.0, 8.0, 7.0, 6.0], cov=cov, source=3))
    assert before.mean[0, 0, 0] != 9.0  # what was published stays what it was
    found = own.step(2 * SECOND, NOTHING, None)
    mean, cov = predict(np.array([9.0, 8.0, 7.0, 6.0]), cov, *MOTION.matrices(1.0))
    np.testing.assert_allclose(found.mean[0, 0], mean)
    np.testing.assert_allclose(found.cov[0, 0], cov)
    assert found.source.tolist() == [3]


def test_provenance_is_never_forgotten():
    own = known()
    for k, source in enumerate((1, 4), start=1):
        own.step(k * SECOND, NOTHING, None)
        own.feed_back(fused_at(k * SECOND, [0.0] * 4, source=source))
    assert own.step(3 * SECOND, NOTHING, None).source.tolist() == [5]
    own.reset()
    assert own.step(0, NOTHING, None).source.tolist() == [0]


def test_feedback_of_another_time_or_of_nothing_is_not_taken():
    own = known()
    own.step(SECOND, NOTHING, None)
    for fused in (fused_at(SECOND - 1, [9.0] * 4), fused_at(2 * SECOND, [9.0] * 4), TrackBatch.empty(LAYOUT, "map")):
        assert not own.feed_back(fused)
    assert not tracker().feed_back(fused_at(-1, [9.0] * 4))
    assert own.step(SECOND, NOTHING, None).mean[0, 0, 0] == 4.0


def test_of_several_fused_tracks_the_nearest_is_taken_and_a_mixture_merged():
    own = known()
    own.step(0, NOTHING, None)
    fused = fused_at(0, [500.0, 2.0, 3.0, 4.0], [1.0, 2.0, 3.0, 4.0])
    mean = np.stack([fused.mean[:, 0], fused.mean[:, 0] + [2.0, 0, 0, 0]], 1)
    mixture = fused.replace(weight=np.full((2, 2), 0.5), mean=mean, cov=np.repeat(fused.cov, 2, 1))
    assert own.feed_back(mixture)
    found = own.step(0, NOTHING, None)
    np.testing.assert_allclose(found.mean[0, 0], [2.0, 2.0, 3.0, 4.0])
    np.testing.assert_allclose(np.diag(found.cov[0, 0]), [2.0, 1.0, 1.0, 1.0])


def test_feedback_with_axes_in_another_order():
    own = known()
    own.step(0, NOTHING, None)
    layout = StateLayout(("vy", "vx", "y", "x"))
    own.feed_back(TrackBatch.gaussian(layout, "map", np.array([[4.0, 3.0, 2.0, 1.0]]), np.eye(4)[None]))
    assert own.step(0, NOTHING, None).mean[0, 0].tolist() == [1.0, 2.0, 3.0, 4.0]


@pytest.mark.parametrize(
    ("params", "text"),
    [
        ({"initial_mean": (1.0, 2.0)}, "The 'initial_mean' parameter must hold 4 numbers, one an axis. Got 2."),
        ({"initial_mean": (0.0,) * 4, "initial_cov": (1.0,) * 3}, "must hold 4 or 16 numbers. Got 3."),
        ({"initial_mean": (0.0,) * 4, "initial_cov": (1.0, 1.0, -1.0, 1.0)}, "parameter does not fit: .*definite"),
        ({"initial_mean": (0.0,) * 4}, "must hold 4 or 16 numbers. Got 0."),
    ],
)
def test_an_initial_state_that_does_not_fit_is_refused(params, text):
    with pytest.raises(ParameterError, match=text):
        tracker(**params)


def test_time_does_not_go_back():
    own = known()
    own.step(SECOND, NOTHING, None)
    with pytest.raises(ValueError, match="must be >= 0 s"):
        own.step(0, NOTHING, None)
