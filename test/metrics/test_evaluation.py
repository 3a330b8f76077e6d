"""Tracks against the truth: matching, errors, consistency, the result as JSON."""

import json
import pickle

import numpy as np
import pytest
import scipy.stats

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


SECOND = 1_000_000_000


def moving(time_s, ids=(1,), offset=0.0, stamp_ns=None):
    """Targets on parabolas, x = 100 id + 5 t^2."""
    mean = np.array([[100.0 * i + 5 * time_s**2 + offset, 0.0, 10 * time_s, 0.0] for i in ids]).reshape(-1, 4)
    return TrackBatch.gaussian(
        LAYOUT, "map", mean, np.tile(np.eye(4), (len(mean), 1, 1)),
        time_ns=round(time_s * SECOND) if stamp_ns is None else stamp_ns, track_id=np.array(ids),
    )  # fmt: skip


def test_tracks_between_the_stamps_of_the_truth_are_judged_there():
    """Truth at 2 Hz, tracks at 10 Hz, both of a target that brakes: all errors are those that were put in."""
    judge = evaluation()
    for k in range(51):
        judge.add_tracks(k * SECOND // 10, moving(k / 10, offset=0.3))
        if k % 5 == 0:
            judge.add_truth(moving(k / 10))
    result = judge.result()
    assert (result["times"], result["missed"], result["false"], result["unjudged"]) == (51, 0, 0, 0)
    assert result["all"]["position_rmse_m"] == pytest.approx(0.3, abs=1e-9)
    assert result["all"]["velocity_rmse_mps"] == pytest.approx(0.0, abs=1e-9)


def test_what_cannot_be_judged_is_counted_and_nothing_called_consistent():
    """The truth ends after 9 s of 10: of scans alone beyond it nobody knows how far off they were."""
    for seconds, verdict, unjudged in ((9, "incomplete", 10), (9.9, "consistent", 1)):
        rng, judge = np.random.default_rng(0), evaluation()
        for k in range(101):
            if k <= 10 * seconds:
                judge.add_truth(moving(k / 10))
            track = moving(k / 10)
            judge.add_tracks(k * SECOND // 10, track.replace(mean=track.mean + rng.normal(size=track.mean.shape)))
        result = judge.result()
        assert (result["unjudged"], result["unjudged_times"]) == (unjudged, unjudged)
        assert (result["times"], result["all"]["verdict"]) == (101 - unjudged, verdict)


def test_bad_news_stands_however_much_is_missing():
    judge = judged(0.1)
    for stamp in range(200, 300):
        judge.add_tracks(stamp, batch([(0, 0)], stamp))
    assert judge.result()["all"]["verdict"] == "overconfident"
    assert judge.result()["unjudged"] == 100


def test_lost_pieces_of_the_truth_are_reported():
    """What no neighbour tells of is unjudged, and the track of that target is not called false."""
    judge = Evaluation(LAYOUT, EvaluationParams(max_gap_s=1.0), whole_truth=False)
    for k in range(10):
        ids = tuple(i for i in (1, 2, 3) if (i, k) not in {(2, 5), (3, 9)})
        for i in ids:
            judge.add_truth(moving(float(k), (i,)))
        judge.add_tracks(k * SECOND, moving(float(k), (1, 2, 3)))
    result = judge.result()
    assert (result["all"]["samples"], result["missed"], result["false"], result["unjudged"]) == (28, 0, 0, 2)


def test_a_truth_without_targets_makes_every_track_false():
    judge = evaluation()
    judge.add_truth(TrackBatch.empty(LAYOUT, "map"), stamp_ns=7)
    judge.add_tracks(7, batch([(0, 0), (5, 0)], 7))
    result = judge.result()
    assert (result["times"], result["false"], result["unjudged"]) == (1, 2, 0)


def test_waiting_scans_are_judged_when_the_truth_comes_late():
    """One message after the other of either: the truth of 60 s after all tracks, and the other way round."""
    for tracks_first in (True, False):
        judge = evaluation()
        for of_tracks in (tracks_first, not tracks_first):
            for k in range(60):
                if of_tracks:
                    judge.add_tracks(k * SECOND, moving(float(k), (1, 2), offset=1.0))
                else:
                    judge.add_truth(moving(float(k), (1, 2)))
        result = judge.result()
        assert (result["times"], result["all"]["samples"], result["unjudged"]) == (60, 120, 0)


def test_while_the_truth_is_away_it_says_so():
    judge = evaluation()
    judge.add_truth(moving(0.0))
    for k in range(5):
        judge.add_tracks(k * SECOND, moving(float(k)))
    assert (judge.unjudged, judge.is_incomplete) == (2, True)
    for k in range(1, 5):
        judge.add_truth(moving(float(k)))
    assert (judge.unjudged, judge.is_incomplete, judge.times) == (0, False, 5)


def test_the_figures_are_those_of_all_samples_kept():
    """Sums and histograms against every sample, as they were once held."""
    rng, judge = np.random.default_rng(3), evaluation()
    errors = rng.normal(size=(500, 2, 4))
    for k, error in enumerate(errors):
        truth = moving(k / 10, (1, 2))
        judge.add_truth(truth)
        judge.add_tracks(k * SECOND // 10, truth.replace(mean=truth.mean + error[:, None], track_id=np.array([8, 9])))
    result = judge.result()
    scores = (errors**2).sum(-1)
    assert result["all"]["anees"] == pytest.approx(scores.mean() / 4, rel=1e-9)
    for j, target in enumerate(("1", "2")):
        figures = result["targets"][target]
        norm = np.linalg.norm(errors[:, j, :2], axis=-1)
        assert figures["position_rmse_m"] == pytest.approx(np.sqrt((norm**2).mean()), rel=1e-9)
        assert figures["position_armse_m"] == pytest.approx(norm.mean(), rel=1e-9)
        assert (figures["track_ids"], figures["id_changes"]) == ([8 + j], 0)
    edges = scipy.stats.chi2.ppf(np.linspace(0, 1, 11), 4)
    assert result["all"]["nees_deciles"] == np.histogram(scores, edges)[0].tolist()


@pytest.mark.parametrize(("missing", "count"), [("", 36_000), ("truth", 12_000), ("tracks", 12_000)])
def test_memory_is_flat_over_an_hour(missing, count):
    """An hour at 10 Hz, identifiers of targets and tracks renewed every 2 s; with truth or tracks absent, a third."""
    judge, sizes, known = evaluation(), [], moving(0.0, (1, 5000))
    for k in range(count):
        known = known.replace(time_ns=np.full(2, k * SECOND // 10), track_id=np.array([1, 5000]) + k // 20)
        if missing != "truth":
            judge.add_truth(known)
        if missing != "tracks":
            judge.add_tracks(k * SECOND // 10, known)
        if k + 1 in (3 * count // 4, count):
            sizes.append(len(pickle.dumps(judge)))
    assert sizes[1] <= 1.02 * sizes[0]
    result = judge.result()
    assert result["times"] == (0 if missing else count)
    if not missing:
        others = result["targets"].pop("others")
        assert others["samples"] + sum(t["samples"] for t in result["targets"].values()) == 72_000
        assert others["targets"] + len(result["targets"]) == 3600


def test_whole_pictures_are_scored():
    """A track 3 m off for two times, then another one; a second target is missed, and a false track far away."""
    judge = evaluation()
    for stamp in range(4):
        judge.add_truth(batch([(0, 0), (500, 0)], stamp, [1, 2]))
        judge.add_tracks(stamp, batch([(3, 0), (200, 0)], stamp, [5 + stamp // 2, 9]))
    scores = judge.result()["scores"]
    assert (scores["times"], scores["cutoff_m"], scores["order"]) == (4, 10.0, 2.0)
    assert scores["gospa_m"] == pytest.approx(np.sqrt(9 + 50 + 50))
    parts = [scores[f"gospa_{part}_m"] for part in ("localisation", "missed", "false")]
    assert parts == pytest.approx([3.0, np.sqrt(50), np.sqrt(50)])
    assert scores["ospa_m"] == pytest.approx(np.sqrt((9 + 100) / 2))
    assert (scores["id_switches"], scores["completeness"], scores["motp_m"]) == (1, 0.5, 3.0)
    assert scores["mota"] == pytest.approx(1 - (4 + 4 + 1) / 8)
    assert scores["idf1"] == pytest.approx(2 * 2 / 16)
    assert evaluation().result()["scores"]["gospa_m"] is None


def test_scores_leave_out_times_at_which_some_truth_is_unknown():
    judge = Evaluation(LAYOUT, EvaluationParams(max_gap_s=1.0), whole_truth=False)
    for k in range(10):
        for i in (1, 2) if k != 9 else (1,):
            judge.add_truth(moving(float(k), (i,)))
        judge.add_tracks(k * SECOND, moving(float(k), (1, 2)))
    scores = judge.result()["scores"]
    assert (scores["times"], scores["gospa_m"], scores["mota"]) == (9, 0.0, 1.0)


def test_latencies_are_told_by_quantiles():
    rng, judge = np.random.default_rng(0), evaluation()
    late_s = rng.exponential(0.02, 2000)
    for k, seconds in enumerate(late_s):
        judge.add_tracks(k, batch([], k), arrival_ns=k + round(seconds * SECOND))
    told = judge.result()["latency"]
    for name, share in (("p50_s", 50), ("p95_s", 95), ("p99_s", 99)):
        assert told[name] == pytest.approx(np.percentile(late_s, share), rel=0.03)
    assert (told["samples"], told["max_s"]) == (2000, pytest.approx(late_s.max(), rel=1e-6))
    assert told["mean_s"] == pytest.approx(late_s.mean(), rel=1e-6)
    assert evaluation().result()["latency"]["p95_s"] is None


def test_extreme_latencies_are_told():
    judge = evaluation()
    for k, seconds in enumerate((-1.0, -1.0, 0.0, 1e6)):
        judge.add_tracks(k, batch([], k), arrival_ns=k + round(seconds * SECOND))
    told = judge.result()["latency"]
    assert (told["p50_s"], told["max_s"]) == (0.0, pytest.approx(1e6))
