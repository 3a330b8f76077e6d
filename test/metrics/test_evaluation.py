"""Tracks against the truth: matching, errors, consistency, the result as JSON."""

import json

import numpy as np
import pytest

from track_fusion.metrics.evaluation import MIN_SAMPLES, Evaluation, EvaluationParams
from track_fusion.metrics.pairing import paired
from track_fusion.tracks import CONFIRMED, StateLayout, TrackBatch, planar_layout

LAYOUT = planar_layout()


def batch(positions, stamp=1, ids=None, cov=None, status=CONFIRMED, speed=0.0):
    mean = np.array([[x, y, speed, 0.0] for x, y in positions]).reshape(-1, 4)
    cov = np.eye(4) if cov is None else cov
    ids = None if ids is None else np.array(ids)
    return TrackBatch.gaussian(
        LAYOUT, "map", mean, np.tile(cov, (len(mean), 1, 1)), time_ns=stamp, track_id=ids, status=status
    )


def evaluation(**params):
    return Evaluation(LAYOUT, EvaluationParams(**params))


def test_matches_by_least_total_distance():
    """The nearest track of target 1 is 20, but then target 2 would have to take the far one."""
    judge = evaluation()
    for position, target in (((0, 0), 1), ((2, 0), 2)):
        judge.add_truth(batch([position], ids=[target]))
    judge.add_tracks(1, batch([(1.1, 0), (-3, 0)], ids=[20, 10]))
    targets = judge.result()["targets"]
    assert {t: r["track_ids"] for t, r in targets.items()} == {"1": [10], "2": [20]}
    assert targets["2"]["position_rmse_m"] == pytest.approx(0.9)
    assert targets["1"]["position_rmse_m"] == pytest.approx(3.0)


def test_counts_missed_targets_and_false_tracks():
    judge = evaluation(max_distance_m=5.0)
    judge.add_truth(batch([(0, 0)], ids=[1]))
    judge.add_truth(batch([(100, 0)], ids=[2]))
    judge.add_tracks(1, batch([(1, 0), (106, 0), (50, 50)], ids=[7, 8, 9]))
    result = judge.result()
    assert (result["missed"], result["false"], result["all"]["samples"]) == (1, 2, 1)
    assert list(result["targets"]) == ["1"]


def test_no_tracks_are_judged_too():
    judge = evaluation()
    judge.add_truth(batch([(0, 0)]))
    judge.add_tracks(1, batch([]))
    result = judge.result()
    assert (result["times"], result["missed"], result["false"]) == (1, 1, 0)
    assert result["all"]["position_rmse_m"] is None
    assert result["all"]["verdict"] == "unknown"


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 2, 1, 0), (2, 0, 3, 1)])
def test_truth_and_tracks_come_in_any_order(order):
    judge = evaluation()
    calls = [
        lambda: judge.add_truth(batch([(0, 0)], 5, [1])),
        lambda: judge.add_truth(batch([(9, 0)], 5, [2])),
        lambda: judge.add_tracks(5, batch([(0, 1), (9, 2)], 5, [3, 4])),
        lambda: judge.add_truth(batch([(0, 0)], 6, [1])),
    ]
    for i in order:
        calls[i]()
    result = judge.result()
    assert (judge.times, result["unmatched_times"]) == (1, 1)
    assert result["all"]["samples"] == judge.consistency().samples == 2
    assert judge.consistency().anees == pytest.approx((1 + 4) / 2 / 4)
    assert (result["missed"], result["false"]) == (0, 0)


def test_a_repeated_truth_counts_once():
    judge = evaluation()
    judge.add_tracks(1, batch([(1, 0)]))
    for x in (0, 0, 3):
        judge.add_truth(batch([(x, 0)], ids=[1]))
    result = judge.result()
    assert (result["missed"], result["all"]["samples"]) == (0, 1)
    assert result["all"]["position_rmse_m"] == pytest.approx(2.0)
    assert judge.consistency().anees == pytest.approx(4.0 / 4)


def test_tentative_tracks_are_judged_by_parameter():
    for confirmed_only, samples in ((True, 0), (False, 1)):
        judge = evaluation(confirmed_only=confirmed_only)
        judge.add_truth(batch([(0, 0)]))
        judge.add_tracks(1, batch([(0, 0)], status=0))
        assert judge.result()["all"]["samples"] == samples


def test_rmse_and_mean_error_of_one_run():
    judge = evaluation()
    for stamp, error in ((1, 3.0), (2, 4.0)):
        judge.add_truth(batch([(0, 0)], stamp, [1]))
        judge.add_tracks(stamp, batch([(error, 0)], stamp, speed=1.0))
    figures = judge.result()["all"]
    assert figures["position_rmse_m"] == pytest.approx(np.sqrt(12.5))
    assert figures["position_armse_m"] == pytest.approx(3.5)
    assert figures["velocity_rmse_mps"] == pytest.approx(1.0)


def judged(claimed_sd, count=200, seed=0):
    rng, judge = np.random.default_rng(seed), evaluation()
    for stamp in range(count):
        judge.add_truth(batch([(0, 0)], stamp))
        error = TrackBatch.gaussian(
            LAYOUT, "map", rng.normal(size=(1, 4)), claimed_sd**2 * np.eye(4)[None], time_ns=stamp
        )
        judge.add_tracks(stamp, error)
    return judge


@pytest.mark.parametrize(
    ("claimed_sd", "verdict", "warned"),
    [(0.7, "overconfident", True), (1.0, "consistent", False), (1.4, "underconfident", False)],
)
def test_warns_of_overconfidence_alone(claimed_sd, verdict, warned):
    judge = judged(claimed_sd)
    assert judge.is_overconfident() is warned
    assert judge.result()["all"]["verdict"] == verdict
    assert judge.result()["all"]["anees"] == pytest.approx(judge.consistency().anees)
    assert judge.result()["all"]["anees"] == pytest.approx(1 / claimed_sd**2, rel=0.15)


def test_few_samples_prove_nothing():
    assert not judged(0.1, MIN_SAMPLES - 1).is_overconfident()
    assert judged(0.1, MIN_SAMPLES).is_overconfident()


def test_angles_are_compared_on_the_circle():
    layout = StateLayout(("x", "y", "yaw"))
    judge = Evaluation(layout, EvaluationParams())
    cov = np.diag([1.0, 1.0, 0.01])[None]
    judge.add_truth(TrackBatch.gaussian(layout, "map", np.array([[0.0, 0.0, 3.1]]), cov, time_ns=1))
    judge.add_tracks(1, TrackBatch.gaussian(layout, "map", np.array([[0.0, 0.0, -3.1]]), cov, time_ns=1))
    assert judge.consistency().anees == pytest.approx((2 * np.pi - 6.2) ** 2 / 0.01 / 3)


def test_the_result_is_json():
    for judge in (evaluation(), judged(1.0, 3)):
        text = json.dumps(judge.result(), allow_nan=False)
        assert json.loads(text) == judge.result()


def test_turn_rates_are_judged_in_degrees_a_second():
    layout = StateLayout(("x", "y", "vx", "vy", "turn_rate"))
    judge = Evaluation(layout, EvaluationParams())
    for stamp, error in ((1, 0.03), (2, -0.01)):
        truth = TrackBatch.gaussian(layout, "map", np.zeros((1, 5)), np.eye(5)[None], time_ns=stamp)
        judge.add_truth(truth)
        judge.add_tracks(stamp, truth.replace(mean=truth.mean + [0, 0, 0, 0, error]))
    figures = judge.result()["all"]
    assert figures["turn_rate_armse_degps"] == pytest.approx(np.degrees(0.02))
    assert figures["turn_rate_rmse_degps"] == pytest.approx(np.degrees(np.sqrt((0.03**2 + 0.01**2) / 2)))
    assert "turn_rate_armse_degps" not in evaluation().result()["all"]


def test_a_box_whose_front_is_unknown_is_judged_by_its_own_period():
    layout = StateLayout(("x", "y", "yaw"), (np.inf, np.inf, np.pi))
    truth, mean = np.array([[0.0, 0.0, 1.5]]), np.array([[0.0, 0.0, -1.6]])
    pairs = paired(layout, truth, mean, np.eye(3)[None], 1.0)
    np.testing.assert_allclose(pairs.error, [[0.0, 0.0, np.pi - 3.1]], atol=1e-12)
