"""What is declared of a source, and a life counted by a source's own rhythm."""

import numpy as np
import pytest
from oracles.kalman import predict, update

from track_fusion.centre.centre import FusionCentre
from track_fusion.centre.config import (
    CentreConfig,
    FusionCentreParams,
    IdentityParams,
    ScanBufferParams,
    SourceConfig,
    SourceSettings,
    TrackManagerParams,
)
from track_fusion.centre.declared import as_declared
from track_fusion.centre.rhythm import STAMPS_KEPT, noted, period_ns
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.params import ParameterError
from track_fusion.rules import RULES
from track_fusion.tracks import TrackBatch, planar_layout

LAYOUT, SECOND, MS = planar_layout(), 10**9, 10**6
PLAIN = SourceSettings()


def config(*settings, rule="covariance_intersection", manager=None, buffer=None, **params):
    motion, own = NearlyConstantVelocity(LAYOUT, MotionParams(process_noise=0.1)), RULES[rule]
    sources = tuple(SourceConfig(f"source_{k}", settings=given) for k, given in enumerate(settings))
    return CentreConfig(
        sources, motion, "map", own, own.params(), FusionCentreParams(**params), manager or TrackManagerParams(),
        buffer or ScanBufferParams(), identity=IdentityParams("test"),
    )  # fmt: skip


def scan(time_ns, *means, cov=None):
    mean = np.array(means, float).reshape(-1, 4)
    covs = np.tile(np.eye(4) if cov is None else cov, (len(mean), 1, 1))
    return TrackBatch.gaussian(LAYOUT, "map", mean, covs, time_ns=time_ns)


def mixed(weight, mean, cov):
    """One track of several components."""
    one = scan(0, np.zeros(4))
    return one.replace(weight=np.array([weight]), mean=np.array([mean], float), cov=np.array([cov], float))


# ---- errors ----------------------------------------------------------------------------------------------------------


def test_a_bias_widens_positions_after_the_scale():
    own = config(SourceSettings(covariance_scale=4.0, bias_sd=3.0))
    told = as_declared(own, 0, scan(0, np.zeros(4), cov=np.diag([1.0, 2.0, 3.0, 4.0])))
    np.testing.assert_allclose(told.cov[0, 0], np.diag([13.0, 17.0, 12.0, 16.0]))
    same = scan(0, np.zeros(4))
    assert as_declared(config(PLAIN), 0, same) is same


def test_mixtures_scale_and_widen_as_a_whole():
    rng, components = np.random.default_rng(0), 3
    root = rng.normal(size=(components, 4, 6))
    before = mixed([0.5, 0.3, 0.2], 5.0 * rng.normal(size=(components, 4)), root @ np.swapaxes(root, 1, 2))
    after = as_declared(config(SourceSettings(covariance_scale=4.0, bias_sd=3.0)), 0, before)
    (mean, cov), (was_mean, was_cov) = after.moments, before.moments
    np.testing.assert_allclose(mean, was_mean, atol=1e-12)
    np.testing.assert_allclose(cov, 4.0 * was_cov + np.diag([9.0, 9.0, 0.0, 0.0]), rtol=1e-12, atol=1e-12)
    assert after.components == components


@pytest.mark.parametrize("bias", [0.0, 3.0])
def test_particles_scale_and_with_a_bias_become_one_gaussian(bias):
    rng = np.random.default_rng(1)
    before = mixed(np.full(50, 0.02), rng.normal(size=(50, 4)), np.zeros((50, 4, 4)))
    own = config(SourceSettings(covariance_scale=4.0, bias_sd=bias), particle_variances=(0.5,) * 4)
    after = as_declared(own, 0, before)
    (mean, cov), (was_mean, was_cov) = after.moments, before.moments
    np.testing.assert_allclose(mean, was_mean, atol=1e-12)
    floor = 0.5 * np.eye(4) if bias else np.zeros((4, 4))
    np.testing.assert_allclose(cov, 4.0 * was_cov + floor + bias**2 * np.diag([1.0, 1.0, 0.0, 0.0]), atol=1e-12)
    assert np.count_nonzero(after.weight) == (1 if bias else 50)
    assert after.cov.any() == bool(bias)
    fuser = FusionCentre(own)
    fuser.step(0, {0: before})
    assert fuser.tracks.faults == ()


def test_a_declared_bias_makes_one_track_and_harms_nobody():
    """FIELD pain 17, with Kalman trackers of sd .05: one track a target, as good as the unbiased source alone."""
    rng, dt, steps, sd = np.random.default_rng(2), 0.1, 300, 0.05
    own = FusionCentre(config(PLAIN, SourceSettings(bias_sd=0.5)))
    f = np.kron([[1, dt], [0, 1]], np.eye(2))
    q = 0.1 * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
    h, r = np.eye(4)[:2], sd**2 * np.eye(2)
    truth = np.array([[0.0, 0.0, 1.0, 0.5], [20.0, 0.0, -0.5, 1.0]])
    bias, start = 0.5 * np.eye(4)[0], np.diag([sd**2, sd**2, 1.0, 1.0])
    state = {(k, t): (truth[t] + k * bias, start) for k in (0, 1) for t in (0, 1)}
    fused_error, alone_error = [], []
    for step in range(1, steps + 1):
        truth = truth @ f.T + rng.multivariate_normal(np.zeros(4), q, 2)
        scans, time_ns = {}, step * 100 * MS
        for k in (0, 1):
            for t in (0, 1):
                seen = truth[t, :2] + rng.normal(size=2) * sd + k * bias[:2]
                state[k, t] = update(*predict(*state[k, t], f, q), seen, h, r)[:2]
            rows = [state[k, t] for t in (0, 1)]
            scans[k] = TrackBatch.gaussian(
                LAYOUT,
                "map",
                np.array([m for m, _ in rows]),
                np.array([(p + p.T) / 2 for _, p in rows]),
                time_ns=time_ns,
            )
        own.step(time_ns, scans)
        assert own.tracks.track_id.tolist() == [1, 2]
        if step > 50:
            fused_error.append(own.tracks.mean[:, 0, :2] - truth[:, :2])
            alone_error.append(scans[0].mean[:, 0, :2] - truth[:, :2])
    rms = [np.sqrt(np.mean(np.square(e))) for e in (fused_error, alone_error)]
    assert rms[0] <= 1.05 * rms[1]


def test_a_constant_bias_of_ten_sd_is_one_track_where_it_is_declared():
    cov = np.diag([0.0025, 0.0025, 0.01, 0.01])
    for bias, count in ((0.5, 1), (0.0, 2)):
        own = FusionCentre(config(PLAIN, SourceSettings(bias_sd=bias)))
        for k in range(60):
            at = k * 100 * MS
            own.step(at, {0: scan(at, [0, 0, 0, 0], cov=cov), 1: scan(at, [0.5, 0, 0, 0], cov=cov)})
        assert len(own.tracks) == count


# ---- who takes part --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("association", ["nearest", "single_target"])
def test_a_source_that_may_not_starts_no_track_and_joins_those_of_others(association):
    shy = SourceSettings(can_initiate=False)
    own = FusionCentre(config(PLAIN, shy, association=association))
    assert own.step(0, {1: scan(0, [0, 0, 0, 0])})[1].changes.born.tolist() == []
    _, info = own.step(SECOND, {0: scan(SECOND, [0, 0, 0, 0]), 1: scan(SECOND, [0.1, 0, 0, 0], [50, 0, 0, 0])})
    assert (info.changes.born.tolist(), own.tracks.source.tolist()) == ([1], [3])
    own.step(2 * SECOND, {1: scan(2 * SECOND, [0.1, 0, 0, 0])})
    assert own.tracks.source.tolist() == [2]


def test_a_source_that_repeats_others_shares_provenance():
    for reported, shared in ((True, 0), (False, 1)):
        own = FusionCentre(config(PLAIN, SourceSettings(is_self_reported=reported)))
        _, info = own.step(0, {0: scan(0, [0, 0, 0, 0]), 1: scan(0, [0, 0, 0, 0])})
        assert info.shared_provenance == shared
        assert own.tracks.source.tolist() == [3]


@pytest.mark.parametrize("offset_s", [-18.0, 0.25, 0.0])
def test_a_clock_offset_is_taken_out_at_the_door(offset_s):
    """A source whose clock is behind by so much gives what one with a right clock does."""
    shift, results = round(offset_s * SECOND), []
    for settings, off in ((PLAIN, 0), (SourceSettings(time_offset_s=offset_s), shift)):
        own, published = FusionCentre(config(PLAIN, settings)), []
        for k in range(200, 206):
            at = k * SECOND // 10
            assert own.receive(0, scan(at, [0, 0, 1, 0]), at, at) is None
            assert own.receive(1, scan(at - off, [0, 0, 1, 0]), at - off, at) is None
            published += own.advance(at)
        results.append([(p.time_ns, p.tracks.source.tolist(), p.tracks.mean.tolist()) for p in published])
    assert results[0] == results[1]
    assert len(results[0]) == 6


def test_an_absurdly_large_scan_is_turned_away_whole_whether_or_not_it_comes_in_pieces():
    own = FusionCentre(config(SourceSettings(max_tracks_per_scan=2)))
    assert own.receive(0, scan(0, *np.eye(4)[:3]), 0, 0) == "too_many_tracks"
    assert own.buffer.silence_s(0, SECOND) == -1.0  # as if it had not been heard
    assert own.receive(0, scan(0, *np.eye(4)[:2]), 0, 0) is None
    pieces = FusionCentre(
        CentreConfig(
            (SourceConfig("pieces", assembles=True, settings=SourceSettings(max_tracks_per_scan=2)),),
            own.config.motion, "map", own.config.rule, own.config.rule_params,
        )
    )  # fmt: skip
    one = scan(0, *np.eye(4)[:3])
    assert [pieces.receive(0, one[k : k + 1], 0, 0) for k in range(3)] == [None, None, "too_many_tracks"]


# ---- life ------------------------------------------------------------------------------------------------------------


def run(own, stamps_s, until_s):
    """Feed one source at these times, look at the clock every half second; the published tracks by time."""
    due, published = sorted(stamps_s), []
    for half in range(2 * until_s + 1):
        now = half * SECOND // 2
        while due and due[0] * SECOND <= now:
            at = round(due.pop(0) * SECOND)
            assert own.receive(0, scan(at, [0, 0, 0, 0]), at, now) is None
        published += own.advance(now)
    return published


@pytest.mark.parametrize("period_s", [1, 6, 20])
def test_a_slow_source_confirms(period_s):
    """FIELD pain 25: one that comes every 6 s never did, since coasting ended at 5 s."""
    published = run(FusionCentre(config(PLAIN)), range(0, 10 * period_s, period_s), 10 * period_s)
    assert [p.tracks.is_confirmed.tolist() for p in published][-1] == [True]
    first = next(p.time_ns for p in published if len(p.tracks))
    assert first <= 2 * period_s * SECOND
    assert len({i for p in published for i in p.tracks.track_id.tolist()}) == 1


@pytest.mark.parametrize(
    ("period_s", "given_s", "coast_s"), [(1, 0.0, 5.0), (6, 0.0, 18.0), (6, 4.0, 4.0), (1, 9.0, 9.0)]
)
def test_how_long_a_track_coasts(period_s, given_s, coast_s):
    manager = TrackManagerParams(confirmation_threshold=(1, 1), max_coast_s=given_s)
    last = 5 * period_s
    published = run(FusionCentre(config(PLAIN, manager=manager)), range(0, last + 1, period_s), last + 60)
    gone = next(p.time_ns for p in published if p.time_ns > last * SECOND and not len(p.tracks))
    assert coast_s < gone / SECOND - last <= coast_s + 1.5


def test_the_period_bears_lost_and_doubled_scans_and_silence():
    stamps, at = (), 0
    for gap in (6, 6, 1, 6, 90, 6, 6, 12, 6, 6, 0, -3):
        at += gap
        stamps = noted(stamps, at * SECOND)
        at -= min(gap, 0)
    assert len(stamps) == STAMPS_KEPT
    assert period_ns(stamps) == 6 * SECOND
    assert [period_ns(s) for s in ((), (5,), (5, 8), (5, 6, 9))] == [0, 0, 3, 3]


def test_several_sources_must_confirm():
    own = FusionCentre(config(PLAIN, PLAIN, manager=TrackManagerParams(confirmation_sources=2)))
    for k in range(4):
        own.step(k * SECOND, {0: scan(k * SECOND, [0, 0, 0, 0])})
    assert own.tracks.is_confirmed.tolist() == [False]
    for k in (4, 5):
        own.step(k * SECOND, {s: scan(k * SECOND, [0, 0, 0, 0]) for s in (0, 1)})
        assert own.tracks.is_confirmed.tolist() == [k == 5]
    with pytest.raises(ParameterError, match="'confirmation_sources' parameter must be at most 1, the .* Got 2."):
        config(PLAIN, manager=TrackManagerParams(confirmation_sources=2))


def test_the_oldest_tentative_tracks_are_dropped_and_confirmed_ones_are_not():
    manager = TrackManagerParams(max_tentative_tracks=3, deletion_threshold=(9, 9))
    # The identifiers of a scan are its rows, so that one names another target at each: no patience with them.
    own = FusionCentre(config(PLAIN, manager=manager, patience=0))
    places = [[100.0 * k, 0, 0, 0] for k in range(9)]
    own.step(0, {0: scan(0, *places[:2])})
    own.step(SECOND, {0: scan(SECOND, *places[:2])})
    assert own.tracks.is_confirmed.tolist() == [True, True]
    _, info = own.step(2 * SECOND, {0: scan(2 * SECOND, *places[:4])})
    assert info.changes.dropped.tolist() == []
    _, info = own.step(3 * SECOND, {0: scan(3 * SECOND, *places[:2], *places[4:9])})
    assert info.changes.dropped.tolist() == [3, 4, 5, 6]
    assert info.changes.deleted.tolist() == []
    assert own.tracks.track_id.tolist() == [1, 2, 7, 8, 9]
