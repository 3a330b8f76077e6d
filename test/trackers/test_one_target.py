"""A sensor's own tracker: initialisation, detections, feedback."""

import numpy as np
import pytest
from filters.plain import Plain, predict, update

from track_fusion.filters import particle
from track_fusion.filters.cubature import Cubature
from track_fusion.filters.extended import Extended
from track_fusion.filters.particle import SirParams
from track_fusion.filters.student_t import StudentT, StudentTParams
from track_fusion.filters.unscented import Unscented
from track_fusion.models.choices import SENSORS, LinearParams, make
from track_fusion.models.measurement import LinearSensor, RangeBearingSensor
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.models.turn import CoordinatedTurn, CoordinatedTurnParams
from track_fusion.params import ParameterError, Params
from track_fusion.random_streams import stream
from track_fusion.trackers.filters import FILTERS
from track_fusion.trackers.one_target import LostTrackError, SensorTracker, SensorTrackerParams
from track_fusion.tracks import COASTED, CONFIRMED, StateLayout, TrackBatch, planar_layout

SECOND = 10**9
LAYOUT = planar_layout()
MOTION = NearlyConstantVelocity(LAYOUT, MotionParams(process_noise=2.0))
NOTHING = np.zeros((0, 2))
ARRAYS = TrackBatch.__dataclass_fields__


def tracker(layout=LAYOUT, sensor_sd=1.0, **params):
    motion, sensor = (
        NearlyConstantVelocity(layout, MotionParams(process_noise=2.0)),
        LinearSensor.position(layout, sensor_sd),
    )
    kalman = FILTERS["kalman"].make(motion, sensor, Params())
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
        ({"initial_cov": (1.0,) * 4}, "'initial_mean' parameter must be given with an initial_cov. Got none."),
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


# ---- the choice of filter ----------------------------------------------------------------------------------------

STATE = np.array([100.0, 50.0, 3.0, -1.0])
COV = np.diag([25.0, 16.0, 4.0, 4.0])
RADAR = RangeBearingSensor(LAYOUT, 2.0, 0.01, (10.0, -20.0))


def radar_tracker(key, params=None, sensor=RADAR, motion=MOTION, **initial):
    initial = initial or {"initial_mean": tuple(STATE), "initial_cov": tuple(COV.ravel())}
    entry = FILTERS[key]
    made = make(FILTERS, key, params or entry.params(), motion, sensor)
    return SensorTracker(motion, sensor, made, "map", SensorTrackerParams(**initial))


@pytest.mark.parametrize(
    ("params", "text"),
    [
        ({"sensor_cov": (1.0, 0.9, 0.0, 1.0)}, "must be symmetric and positive definite. Got .1.0, 0.9, 0.0, 1.0"),
        ({"sensor_cov": (1.0, -1.0)}, "must be symmetric and positive definite"),
        ({"sensor_cov": (1.0, np.inf)}, "must be symmetric and positive definite"),
        ({"sensor_cov": (1.0,)}, "must hold 2 or 4 numbers. Got 1."),
        ({"sensor_axes": ("x", "x")}, "must hold distinct axes, at least one. Got .'x', 'x'"),
        ({"sensor_axes": (), "sensor_cov": ()}, "must hold distinct axes, at least one"),
        ({"sensor_axes": ("x", "q")}, "no axis q"),
    ],
)
def test_a_linear_sensor_that_does_not_fit_is_refused(params, text):
    with pytest.raises(ParameterError, match=text):
        make(SENSORS, "linear", LinearParams(**params), LAYOUT)


@pytest.mark.parametrize("key", ["extended", "unscented", "cubature", "student_t"])
def test_each_filter_is_the_one_of_its_name(key):
    params = StudentTParams(dof=4.0) if key == "student_t" else None
    named = {"extended": Extended(), "unscented": Unscented(), "cubature": Cubature()}
    one = Plain(StudentT(params) if params else named[key])
    z = RADAR.observe(STATE) + [1.5, 0.01]
    mean, cov, _ = one.update(*one.predict(STATE, COV, MOTION.over(2.0)), z, RADAR)
    found = radar_tracker(key, params).step(2 * SECOND, z[None], None)
    np.testing.assert_allclose(found.mean[0, 0], mean, rtol=1e-12)
    np.testing.assert_allclose(found.cov[0, 0], cov, rtol=1e-12)
    assert found.dof.tolist() == [4.0 if key == "student_t" else np.inf]


@pytest.mark.parametrize("key", FILTERS)
def test_filters_agree_where_all_is_linear_and_nearly_gaussian(key):
    """Many particles, many degrees of freedom: then every filter approaches Kalman's."""
    params = {"particle": SirParams(particles=40_000), "student_t": StudentTParams(dof=1e6)}.get(key)
    sensor = LinearSensor.position(LAYOUT, 3.0)
    own = radar_tracker(key, params, sensor)
    mean, cov = STATE, COV
    for k, z in enumerate(np.array([[103.0, 49.0], [106.0, 47.0], [110.0, 47.0]]), start=1):
        found = own.step(k * SECOND, z[None], None)
        mean, cov = predict(mean, cov, *MOTION.matrices(1.0))
        mean, cov, _ = update(mean, cov, z, sensor.matrix, sensor.noise)
    (found_mean,), (found_cov,) = found.moments
    close = {"particle": 0.05, "student_t": 1e-5}.get(key, 1e-9)
    sd = np.sqrt(np.diag(cov))
    np.testing.assert_allclose((found_mean - mean) / sd, 0.0, atol=close)
    np.testing.assert_allclose((found_cov - cov) / np.outer(sd, sd), 0.0, atol=close)


def test_a_detection_brings_its_own_noise():
    z, noise = RADAR.observe(STATE) + [4.0, 0.0], np.diag([100.0, 1.0])
    one, sensor = Plain(Extended()), RangeBearingSensor(LAYOUT, 10.0, 1.0, (10.0, -20.0))
    mean, cov, _ = one.update(*one.predict(STATE, COV, MOTION.over(1.0)), z, sensor)
    found = radar_tracker("extended").step(SECOND, z[None], noise[None])
    np.testing.assert_allclose(found.mean[0, 0], mean, rtol=1e-12)
    np.testing.assert_allclose(found.cov[0, 0], cov, rtol=1e-12)


def test_a_radar_starts_a_track_from_a_detection_and_keeps_to_the_nearest():
    own = radar_tracker("extended", initial_speed_sd=5.0)
    z = RADAR.observe(STATE)
    found = own.step(SECOND, z[None], None)
    np.testing.assert_allclose(found.mean[0, 0], [100.0, 50.0, 0.0, 0.0], atol=1e-9)
    across = found.cov[0, 0, :2, :2] @ [-70.0, 90.0] / np.hypot(70.0, 90.0)
    np.testing.assert_allclose(across, 0.01**2 * np.hypot(70.0, 90.0) * np.array([-70.0, 90.0]), rtol=1e-9)
    assert found.cov[0, 0, 2, 2] == 25.0
    far = np.stack([z + [500.0, 0.0], z + [0.0, 0.02 - 2 * np.pi], z + [0.0, 1.0]])
    again = own.step(2 * SECOND, far, None)
    assert np.hypot(*(again.mean[0, 0, :2] - [100.0, 50.0])) < 10.0


def test_a_sensor_of_velocities_needs_an_initial_state():
    sensor = LinearSensor(("vx", "vy"), np.eye(4)[2:], np.eye(2))
    with pytest.raises(ParameterError, match=r"parameter must be given: from detections of vx, vy alone"):
        radar_tracker("kalman", sensor=sensor, initial_speed_sd=1.0)
    found = radar_tracker("kalman", sensor=sensor).step(SECOND, np.array([[5.0, 5.0]]), None)
    assert found.mean[0, 0, 2] > 4.0


def test_a_turn_rate_starts_unknown():
    layout = StateLayout(("x", "y", "vx", "vy", "turn_rate"))
    motion = CoordinatedTurn(layout, CoordinatedTurnParams())
    own = radar_tracker("cubature", None, RangeBearingSensor(layout, 1.0, 0.1), motion, initial_turn_rate_sd=0.2)
    found = own.step(SECOND, np.array([[100.0, 0.5]]), None)
    assert found.cov[0, 0, 4].tolist() == [0.0, 0.0, 0.0, 0.0, pytest.approx(0.04)]


def test_kalman_needs_linear_models():
    with pytest.raises(ParameterError, match="must be one for non-linear models, .* Got 'kalman'"):
        radar_tracker("kalman")


# ---- particles ---------------------------------------------------------------------------------------------------


def cloud_of(track):
    return particle.Particles(track.mean[0], np.log(track.weight[0]))


def sir(**params):
    return SirParams(**{"particles": 50, "seed": 3, "run": 2, "role": "sir a", **params})


def gaussian(rng, mean, cov):
    """Fifty draws of a Gaussian."""
    return mean + rng.normal(size=(50, 4)) @ np.linalg.cholesky(cov).T


def moved(rng, points):
    """Points a second later."""
    transition = MOTION.over(1.0)
    return transition.advance(points) + rng.normal(size=(50, 4)) @ transition.noise_factor(points).T


def test_particles_are_drawn_in_the_order_of_the_library():
    """Initial draw; then at each step motion and, before the next, resampling."""
    own, rng = radar_tracker("particle", sir()), stream(3, 2, "sir a")
    points = gaussian(rng, STATE, COV)
    for k in range(1, 4):
        z = RADAR.observe(STATE) + [k, 0.0]
        points = moved(rng, points)
        square = (RADAR.residual(z, RADAR.observe(points)) ** 2 / np.diag(RADAR.noise)).sum(1)
        weight = np.exp(-0.5 * square) / np.exp(-0.5 * square).sum()
        found = own.step(k * SECOND, z[None], None)
        np.testing.assert_allclose(found.mean[0], points, rtol=1e-12)
        np.testing.assert_allclose(found.weight[0], weight, rtol=1e-9, atol=1e-300)
        points = particle.resample_systematic(particle.Particles(points, np.log(weight)), rng).points
    assert not found.cov.any()


def test_particles_are_drawn_again_from_what_is_fed_back():
    z = RADAR.observe(STATE)[None]
    for fused in (fused_at(SECOND, [1.0, 2.0, 3.0, 4.0], cov=4 * np.eye(4)), None):
        own, rng = radar_tracker("particle", sir()), stream(3, 2, "sir a")
        own_track = own.step(SECOND, z, None)
        gaussian(rng, STATE, COV)
        moved(rng, STATE)
        if fused is None:  # particles of two sources in one track
            both = particle.union([cloud_of(own_track), cloud_of(own_track)], np.array([0.25, 0.75]))
            fused = own_track.replace(mean=both.points[None], weight=both.weight[None], cov=np.zeros((1, 100, 4, 4)))
            points = particle.resample_systematic(both, rng, 50).points
        else:
            points = gaussian(rng, fused.mean[0, 0], fused.cov[0, 0])
        assert own.feed_back(fused)
        found = own.step(2 * SECOND, np.zeros((0, 2)), None)
        np.testing.assert_allclose(found.mean[0], moved(rng, points), rtol=1e-12)


def test_particles_begin_anew_with_the_tracker():
    own = radar_tracker("particle", sir())
    first = own.step(SECOND, RADAR.observe(STATE)[None], None)
    own.reset()
    again = own.step(SECOND, RADAR.observe(STATE)[None], None)
    np.testing.assert_array_equal(first.mean, again.mean)
    np.testing.assert_array_equal(first.weight, again.weight)


def test_particles_without_weight_do_not_vanish():
    """A surprise leaves one particle all the weight; a track of one row without covariance would be an error."""
    own = radar_tracker("particle", sir())
    found = own.step(SECOND, RADAR.observe(STATE)[None] + [2000.0, 0.0], None)
    assert found.weight.max() > 1 - 1e-12
    assert (found.weight > 0).all()
    batch, rejected = TrackBatch.screened(**{k: v for k, v in vars(found).items() if k in ARRAYS})
    assert (len(batch), +rejected) == (1, {})


# ---- wild detections ------------------------------------------------------------------------------------------------


def steps(own, *scans):
    """Step through (time, detection, variance or None); say for each what is published: good, or why nothing."""
    for time_s, z, variance in scans:
        covs = None if variance is None else variance * np.eye(2)[None]
        try:
            batch = own.step(time_s * SECOND, np.array([z]), covs)
        except LostTrackError as error:
            yield error.reason
        else:
            yield ", ".join(batch.faults) or "good"


@pytest.mark.parametrize("key", [key for key in FILTERS if key != "kalman"])
def test_a_track_lost_to_a_wild_detection_starts_anew(key):
    """Detections as far and as sharp as the screening lets pass wreck any filter; it must not stay so."""
    layout = StateLayout(("x", "y", "vx", "vy", "turn_rate"))
    turning = CoordinatedTurn(layout, CoordinatedTurnParams())
    sensor = LinearSensor.position(layout, 1.0)
    track_filter = make(FILTERS, key, FILTERS[key].params(), turning, sensor)
    own = SensorTracker(turning, sensor, track_filter, "map", SensorTrackerParams())
    wild = [(1, (5.0, 1.0), 1.0), (2, (9e11, 1.0), 1.0), (3, (5.0, 1.0), 1.0), (4, (9e11, 9e11), 1e-20)]
    tame = [(k, (5.0, 1.0), 1.0) for k in range(5, 12)]
    found = list(steps(own, *wild, *tame))
    assert set(found) <= {"good", "lost_track"}
    assert found[0] == found[-1] == "good"
    assert key == "particle" or "lost_track" in found
    if "lost_track" in found:  # the state is that of the detections since
        (mean,), _ = own.step(12 * SECOND, np.array([[5.0, 1.0]]), None).moments
        np.testing.assert_allclose(mean[:2], [5.0, 1.0], atol=1e-3 if key != "particle" else 5.0)


@pytest.mark.parametrize("z", [(0.0, 0.5), (0.0, 1.0), (1e-9, 1.0), (1e12, 1.0)])
def test_a_detection_from_which_no_track_can_start_is_told(z):
    """At range 0 a bearing says nothing: the position has no covariance across."""
    own = radar_tracker("extended", initial_speed_sd=10.0)
    far = [(1, z, 1e20 if z[0] > 1.0 else None), (2, (500.0, 1.0), None)]
    assert list(steps(own, *far)) == ["cannot_start", "good"]


def test_a_lost_track_that_detections_cannot_start_goes_back_to_its_initial_state():
    motion, sensor = MOTION, LinearSensor(("vx", "vy"), np.eye(4)[2:], np.eye(2))
    kalman = FILTERS["kalman"].make(motion, sensor, Params())
    initial = SensorTrackerParams(initial_mean=(1.0, 2.0, 3.0, 4.0), initial_cov=(1.0,) * 4)
    own = SensorTracker(motion, sensor, kalman, "map", initial)
    found = list(steps(own, (1, (3.0, 4.0), None), (2, (9e11, 0.0), 1e-20), (3, (9e11, 0.0), 1e-20)))
    assert (found[0], found[-1]) == ("good", "lost_track")
    assert own.time_ns == 0
