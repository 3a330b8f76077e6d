"""Probabilistic data association against the enumeration of hypotheses; a tracker that begins and ends tracks."""

import numpy as np
import pytest
from oracles import kalman
from scipy.stats import chi2, multivariate_normal

from track_fusion.filters.probabilistic_data_association import (
    Candidate,
    ClutterParams,
    ProbabilisticDataAssociation,
    Scan,
    update_existence,
)
from track_fusion.models.measurement import LinearSensor, RangeBearingSensor
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.trackers.many_targets import PdaTracker, PdaTrackerParams
from track_fusion.tracks import planar_layout

LAYOUT = planar_layout()
SENSOR = LinearSensor.position(LAYOUT, 3.0)
MOTION = NearlyConstantVelocity(LAYOUT, MotionParams(process_noise=10.0))
MEAN, COV = np.array([10.0, -5.0, 4.0, 3.0]), np.diag([20.0, 12.0, 4.0, 4.0]) + 1.0
ALL = np.ones(1, bool)


def update(mean, cov, zs, present, sensor, params, existence=0.5):
    """Posterior, and what was learned, of targets that exist with a probability."""
    state = Candidate(mean, cov, np.asarray(existence))
    return ProbabilisticDataAssociation(params).update(state, Scan(zs, present), sensor)


def hypotheses(zs, existence, detection, density, volume=1000.0):
    """Every explanation of a scan: (weight, mean, cov) of the target; the first is that there is none."""
    clutter = len(zs)
    poisson = [np.exp(-density * volume) * density**k for k in (clutter, clutter - 1)]
    yield (1 - existence) * poisson[0], None, None
    yield existence * (1 - detection) * poisson[0], MEAN, COV
    for z in zs:
        spread = SENSOR.matrix @ COV @ SENSOR.matrix.T + SENSOR.noise
        density_z = multivariate_normal(SENSOR.matrix @ MEAN, spread).pdf(z)
        mean, cov, _ = kalman.update(MEAN, COV, z, SENSOR.matrix, SENSOR.noise)
        yield existence * detection * density_z * poisson[1], mean, cov


@pytest.mark.parametrize(
    ("count", "detection"), [(0, 0.3), (0, 0.9), (1, 0.3), (1, 0.9), (1, 1.0), (4, 0.3), (4, 0.9), (4, 1.0)]
)
def test_update_and_existence_are_the_moments_over_all_hypotheses(count, detection):
    rng, existence = np.random.default_rng(count), 0.4
    zs = MEAN[:2] + 6.0 * rng.normal(size=(count, 2))
    weight, mean, cov = zip(*hypotheses(zs, existence, detection, 0.02), strict=True)
    weight = np.array(weight) / sum(weight)
    share = weight[1:] / weight[1:].sum()
    whole = share @ np.array(mean[1:])
    spread = sum(w * (c + np.outer(m - whole, m - whole)) for w, m, c in zip(share, mean[1:], cov[1:], strict=True))
    params = ClutterParams(detection_probability=detection, gate_probability=1.0, clutter_density=0.02)
    posterior, learned = update(MEAN, COV, zs, np.ones(count, bool), SENSOR, params, existence)
    np.testing.assert_allclose(posterior.mean, whole, rtol=1e-10)
    np.testing.assert_allclose(posterior.cov, spread, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(learned.weight, np.roll(share, -1), rtol=1e-9, atol=1e-15)
    assert posterior.existence == pytest.approx(1 - weight[0], rel=1e-10)


def test_one_sure_detection_is_the_kalman_filter():
    z = np.array([[12.0, -4.0]])
    params = ClutterParams(detection_probability=1.0, gate_probability=1.0, clutter_density=1e-30)
    posterior, _ = update(MEAN, COV, z, ALL, SENSOR, params)
    wanted = kalman.update(MEAN, COV, z[0], SENSOR.matrix, SENSOR.noise)
    np.testing.assert_allclose(posterior.mean, wanted[0], rtol=1e-12)
    np.testing.assert_allclose(posterior.cov, wanted[1], rtol=1e-11, atol=1e-12)


def test_detections_outside_the_gate_and_padding_change_nothing():
    zs, params = np.array([[12.0, -4.0], [200.0, 0.0], [9.0, -6.0]]), ClutterParams()
    whole, learned = update(MEAN, COV, zs, np.array([True, True, False]), SENSOR, params)
    alone, learned_alone = update(MEAN, COV, zs[:1], ALL, SENSOR, params)
    np.testing.assert_allclose(whole.mean, alone.mean, rtol=1e-13)
    np.testing.assert_allclose(whole.cov, alone.cov, rtol=1e-12)
    np.testing.assert_array_equal(learned.gated, [True, False, False])
    assert learned.log_ratio == pytest.approx(float(learned_alone.log_ratio))


def test_the_gate_holds_its_share_of_the_targets_detections():
    rng, params = np.random.default_rng(0), ClutterParams(gate_probability=0.9)
    spread = SENSOR.matrix @ COV @ SENSOR.matrix.T + SENSOR.noise
    zs = rng.multivariate_normal(MEAN[:2], spread, 20_000)
    _, learned = update(MEAN, COV, zs, np.ones(len(zs), bool), SENSOR, params)
    assert learned.gated.mean() == pytest.approx(0.9, abs=0.01)


@pytest.mark.parametrize("lead", [(), (1,), (3, 2), (0,)])
def test_batch_equals_loop(lead):
    rng, sensor = np.random.default_rng(1), RangeBearingSensor(LAYOUT, 5.0, 0.05, (-50.0, 10.0))
    mean, cov = MEAN + rng.normal(size=(*lead, 4)), np.broadcast_to(COV, (*lead, 4, 4))
    zs = sensor.observe(mean)[..., None, :] + rng.normal(size=(*lead, 3, 2)) * [8.0, 0.1]
    present, params = rng.random((*lead, 3)) < 0.7, ClutterParams(clutter_density=0.01)
    whole, learned = update(mean, cov, zs, present, sensor, params)
    assert learned.log_ratio.shape == lead
    for i in np.ndindex(lead):
        alone, single = update(mean[i], cov[i], zs[i], present[i], sensor, params)
        for a, b in ((whole.mean[i], alone.mean), (whole.cov[i], alone.cov), (learned.weight[i], single.weight)):
            np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12)


def test_existence_fades_without_detections_and_survives_huge_ratios():
    params = ClutterParams(survival_probability=0.9)
    state = Candidate(MEAN, COV, np.array(0.5))
    assert ProbabilisticDataAssociation(params).predict(state, MOTION.over(SCAN_S)).existence == pytest.approx(0.45)
    found = update_existence(np.array([0.5, 0.5, 0.0, 1.0]), np.array([1e4, -1e4, 50.0, -50.0]))
    np.testing.assert_allclose(found, [1.0, 0.0, 0.0, 1.0], atol=1e-12)


# ---- the tracker ----------------------------------------------------------------------------------------------------

RADAR = RangeBearingSensor(LAYOUT, 50.0, np.radians(0.2), (1000.0, -2000.0))
DENSITY, SECTOR, REACH_M, SCAN_S = 5e-3, (0.0, 1.0), (15e3, 60e3), 2.0


def scene(rng, steps, last_of_third=15):
    """Three crossing-free targets, the third gone after some scans: truth (T, 3, 4), and each scan's detections."""
    start = np.array([[30e3, 12e3, 150.0, 40.0], [22e3, 20e3, -80.0, 120.0], [40e3, 25e3, 60.0, -140.0]])
    for k in range(steps):
        truth = start.copy()
        truth[:, :2] += k * SCAN_S * start[:, 2:]
        seen = RADAR.observe(truth) + rng.normal(size=(3, 2)) * np.sqrt(np.diag(RADAR.noise))
        kept = (rng.random(3) < 0.9) & ((np.arange(3) < 2) | (k <= last_of_third))
        false = rng.poisson(DENSITY * (REACH_M[1] - REACH_M[0]) * (SECTOR[1] - SECTOR[0]))
        clutter = rng.uniform([REACH_M[0], SECTOR[0]], [REACH_M[1], SECTOR[1]], (false, 2))
        yield truth, rng.permutation(np.concatenate([seen[kept], clutter]))


def tracker(**changes):
    return PdaTracker(MOTION, RADAR, "map", PdaTrackerParams(clutter_density=DENSITY, **changes))


def test_targets_are_found_tracked_and_given_up_in_clutter():
    """Ten scenes of 30 scans with 225 false detections each: targets found by scan 8, few false tracks, NEES right."""
    nees, found, false, ghosts = [], [], [], []
    for scene_index in range(10):
        one = tracker()
        for k, (truth, detections) in enumerate(scene(np.random.default_rng(scene_index), 30)):
            batch = one.step(int(k * SCAN_S * 1e9), detections)
            mean, cov = batch.moments
            gap = mean[None, :, :2] - truth[:, None, :2]
            near = np.linalg.norm(gap, axis=-1) < 1500.0
            alive = np.array([True, True, k <= 15])
            if k in (8, 15, 29):
                found.append(near.any(1)[alive])
                false.append((~near.any(0)).sum())
            if k == 29:
                ghosts.append(near[2].any())
            if k >= 8:
                for t in np.flatnonzero(alive & (near.sum(1) == 1)):
                    i = int(near[t].argmax())
                    error = mean[i] - truth[t]
                    nees.append(error @ np.linalg.solve(cov[i], error))
    assert np.concatenate(found).mean() > 0.93
    assert np.mean(false) < 0.5
    assert np.mean(ghosts) < 0.2
    # These targets do not accelerate at all, which the filter's process noise allows for: NEES below its 4 axes.
    assert 1.5 < np.mean(nees) < 4.0
    assert np.mean(np.array(nees) < chi2.ppf(0.999, 4)) > 0.95


def test_a_lost_target_is_deleted():
    one = tracker()
    scans = list(scene(np.random.default_rng(3), 12))
    for k, (_, detections) in enumerate(scans):
        batch = one.step(int(k * SCAN_S * 1e9), detections)
    assert len(batch) >= 3
    ids = set(batch.track_id)
    for k in range(12, 20):
        batch = one.step(int(k * SCAN_S * 1e9), np.zeros((0, 2)))
    assert len(batch) == 0
    assert len(one.tracks.mean) == 0
    assert len(ids) == len(set(ids))


def test_without_clutter_each_target_has_one_track_and_keeps_it():
    rng, one, ids = np.random.default_rng(4), tracker(detection_probability=0.999), []
    for k, (truth, _) in enumerate(scene(rng, 20, 99)):
        seen = RADAR.observe(truth) + rng.normal(size=(3, 2)) * np.sqrt(np.diag(RADAR.noise))
        batch = one.step(int(k * SCAN_S * 1e9), seen)
        ids.append(tuple(batch.track_id))
    assert len(ids[5]) == 3
    assert set(ids[5:]) == {ids[5]}
    one.reset()
    assert len(one.step(0, np.zeros((0, 2)))) == 0


def test_an_empty_beginning_is_no_fault():
    one = tracker()
    for k in range(3):
        assert len(one.step(k * 2_000_000_000, np.zeros((0, 2)))) == 0
    assert len(one.step(6_000_000_000, np.array([[20e3, 0.5]]))) == 0


def test_bearings_may_be_counted_from_zero_to_two_pi():
    """A target to the west, whose bearings lie around pi."""
    rng, sensor = np.random.default_rng(5), RangeBearingSensor(LAYOUT, 50.0, np.radians(0.2))
    states = np.array([-40e3, 100.0, 10.0, -60.0]) + SCAN_S * np.arange(15)[:, None] * np.array([10.0, -60.0, 0.0, 0.0])
    seen = sensor.observe(states) + rng.normal(size=(15, 2)) * np.sqrt(np.diag(sensor.noise))
    assert np.ptp(np.sign(seen[:, 1])) == 2.0
    batches = []
    for turn in (0.0, 2.0 * np.pi):
        one = PdaTracker(MOTION, sensor, "map", PdaTrackerParams(clutter_density=DENSITY))
        for k, z in enumerate(seen):
            batch = one.step(int(k * SCAN_S * 1e9), np.array([[z[0], z[1] % (2 * np.pi) if turn else z[1]]]))
        batches.append(batch)
    assert [len(b) for b in batches] == [1, 1]
    np.testing.assert_allclose(batches[1].mean, batches[0].mean, rtol=1e-9)
    assert np.linalg.norm(batches[0].mean[0, 0, :2] - states[-1, :2]) < 600.0


@pytest.mark.parametrize("reach_m", [300.0, 30e3])
def test_the_search_misses_no_detection_in_a_gate(reach_m):
    """Of tracks all round the radar, some so near that their gates hold all bearings."""
    rng, one = np.random.default_rng(6), tracker()
    mean = np.concatenate([RADAR.location + rng.uniform(-reach_m, reach_m, (40, 2)), np.zeros((40, 2))], 1)
    a = rng.normal(size=(40, 4, 4)) * np.array([300.0, 300.0, 30.0, 30.0])[:, None]
    cov = a @ np.swapaxes(a, 1, 2)
    values = rng.uniform([0.0, -np.pi], [1.5 * reach_m, np.pi], (300, 2))
    present = np.ones((40, 300), bool)
    gated = update(mean, cov, np.tile(values, (40, 1, 1)), present, RADAR, one.params)[1].gated
    found = np.zeros_like(gated)
    found[one._near(mean, cov, values)] = True
    assert gated.any()
    assert not (gated & ~found).any()
    assert found.sum() < 2 * gated.sum() + 50


# ---- crowds ---------------------------------------------------------------------------------------------------------


def crowd(rng, count, spread_m=50.0):
    """Detections around one place."""
    place = np.array([30e3, 20e3]) + rng.normal(size=(count, 2)) * spread_m
    return RADAR.observe(np.concatenate([place, np.zeros((count, 2))], 1))


def test_a_crowd_of_detections_begins_no_crowd_of_tracks():
    """300 detections in one place made 90,000 tentative tracks of two scans."""
    rng, one = np.random.default_rng(8), tracker()
    for k in range(6):
        one.step(int(k * SCAN_S * 1e9), crowd(rng, 300))
        assert len(one.tracks.mean) <= 300 * max(k, 1)
    assert one.tracks.dropped == 0


def test_beside_a_crowd_a_lone_target_is_found_as_without():
    rng, alone, beside = np.random.default_rng(9), tracker(), tracker()
    for k in range(8):
        state = np.array([[-40e3 + k * SCAN_S * 100.0, 5e3, 100.0, 0.0]])
        seen, at_ns = RADAR.observe(state), int(k * SCAN_S * 1e9)
        expected = alone.step(at_ns, seen)
        got = beside.step(at_ns, np.concatenate([crowd(rng, 200), seen]))
        near = np.linalg.norm(got.mean[:, 0, :2] - state[:, :2], axis=1) < 5e3
        np.testing.assert_allclose(got.mean[near], expected.mean, rtol=1e-9)
    assert len(expected) == 1


def test_the_oldest_tentative_tracks_are_dropped_and_counted():
    rng, one, free = np.random.default_rng(10), tracker(max_tentative_tracks=50), tracker()
    for k, (_, detections) in enumerate(scene(rng, 4)):
        one.step(int(k * SCAN_S * 1e9), detections)
        free.step(int(k * SCAN_S * 1e9), detections)
    assert (~free.tracks.confirmed).sum() > 50
    assert (~one.tracks.confirmed).sum() == 50
    assert one.tracks.dropped > 0
    assert free.tracks.dropped == 0
    assert one.tracks.next_id - one.tracks.track_id[~one.tracks.confirmed].min() < free.tracks.next_id - (
        free.tracks.track_id[~free.tracks.confirmed].min()
    )
    one.reset()
    assert one.tracks.dropped == 0
