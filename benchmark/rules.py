"""Fusion rules against one scipy.optimize call a fusion, and against the LAPACK calls they rest on."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from benchmark import baselines
from benchmark.measure import Result, race
from track_fusion.rules import SourceTracks, get_rule

AXES = 6
#: x1, P1, x2, P2 -> x, P
Fusion = Callable[..., tuple[baselines.Array, baselines.Array]]
#: A baseline is timed on so many fusions of the batch and scaled up: it is a loop.
SAMPLE = 50


def run() -> Iterator[Result]:
    """Measure covariance intersection of pairs and of five sources, what subtracts a common part, and bounds."""
    for count in (1, 100, 1000, 10000):
        yield from _pairs(count, "det")
    yield from _pairs(1000, "trace", floor=False)
    yield from _five()
    yield from _common_parts()
    yield from _unions()
    yield from _others()
    yield from _table_1_of_sharma()


def _tracks(seed: int, count: int, sources: int) -> SourceTracks:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(count, sources, AXES, AXES + 2))
    return SourceTracks(rng.normal(size=(count, sources, AXES)), root @ np.swapaxes(root, -1, -2))


def _pairs(count: int, criterion: str, floor: bool = True) -> Iterator[Result]:
    rule, tracks = get_rule("covariance_intersection"), _tracks(1, count, 2)
    params = rule.params(criterion=criterion)  # type: ignore[call-arg]
    means, covs = tracks.mean[:SAMPLE], tracks.cov[:SAMPLE]
    p1, p2 = (np.ascontiguousarray(tracks.cov[:, i]) for i in (0, 1))

    def loop() -> None:
        for (x1, x2), (c1, c2) in zip(means, covs, strict=True):
            baselines.covariance_intersection_minimize_scalar(x1, c1, x2, c2)

    ours, lapack, users = race(lambda: rule.fuse(tracks, params), lambda: baselines.lapack_floor(p1, p2), loop)
    users *= count / len(means)
    name = f"CI, {criterion}, {count} pair{'s' * (count > 1)}"
    # One pair: no slower than 1.2 times the baseline.
    target = 20.0 if count >= 1000 else 1 / 1.2 if count == 1 else None
    yield Result(name, ours / count, f"minimize_scalar, {_micro(users / count)}", users / ours, at_least=target)
    if floor:
        limit = 3.0 if count >= 1000 else None
        yield Result(
            name, ours / count, f"Cholesky + eigh + inv, {_micro(lapack / count)}", ours / lapack, at_most=limit
        )


def _five(count: int = 1000, sample: int = 10) -> Iterator[Result]:
    rule, tracks = get_rule("covariance_intersection"), _tracks(2, count, 5)
    params = rule.params()

    def loop() -> None:
        for means, covs in zip(tracks.mean[:sample], tracks.cov[:sample], strict=True):
            baselines.covariance_intersection_slsqp(means, covs)

    ours, users = race(lambda: rule.fuse(tracks, params), loop)
    ours, users = ours / count, users / sample
    yield Result(f"CI of 5 sources, det, {count} fusions", ours, f"SLSQP, {_micro(users)}", users / ours, at_least=50.0)


def _common_parts(count: int = 1000) -> Iterator[Result]:
    """Pairwise rules with a weight of their own to find: inverse intersection and the harmonic mean."""
    tracks = _tracks(4, count, 2)
    means, covs = tracks.mean[:SAMPLE], tracks.cov[:SAMPLE]
    for key, baseline in (
        ("inverse_covariance_intersection", baselines.inverse_covariance_intersection_minimize_scalar),
        ("harmonic_mean", baselines.harmonic_mean_minimize_scalar),
    ):
        rule = get_rule(key)
        params = rule.params()

        def loop(baseline: Fusion = baseline) -> None:
            for (x1, x2), (c1, c2) in zip(means, covs, strict=True):
                baseline(x1, c1, x2, c2)

        ours, users = race(lambda rule=rule, params=params: rule.fuse(tracks, params), loop)
        ours, users = ours / count, users / len(means)
        job = f"{rule.title}, det, {count} pairs"
        yield Result(job, ours, f"minimize_scalar, {_micro(users)}", users / ours, at_least=20.0)


def _unions() -> Iterator[Result]:
    """Least-determinant bounds: of pairs about the arithmetic mean, of three sources about the best mean."""
    rule = get_rule("covariance_union")
    for sources, mean, count in ((2, "arithmetic", 1000), (3, "optimal", 50)):
        tracks, params = _tracks(5, count, sources), rule.params(mean=mean)  # type: ignore[call-arg]
        x, c = tracks.mean[0], tracks.cov[0]
        ours, users = race(
            lambda tracks=tracks, params=params: rule.fuse(tracks, params),
            lambda x=x, c=c, mean=mean: baselines.covariance_union_slsqp(x, c, mean == "optimal"),
        )
        job = f"{rule.title} of {sources}, det, {mean} mean, {count} fusions"
        yield Result(job, ours / count, f"SLSQP, {_micro(users)}", users * count / ours, at_least=20.0)


def _others(count: int = 1000) -> Iterator[Result]:
    """Time every other pairwise use of the rules against covariance intersection, for orientation."""
    tracks = _tracks(3, count, 2)
    reference = get_rule("covariance_intersection")
    for key in ("naive", "fast_covariance_intersection", "ellipsoidal_intersection", "cross_covariance",
                "arithmetic_average"):  # fmt: skip
        rule = get_rule(key)
        ours, other = race(
            lambda rule=rule: rule.fuse(tracks, rule.params()), lambda: reference.fuse(tracks, reference.params())
        )
        yield Result(f"{rule.title}, {count} pairs", ours / count, f"CI, {_micro(other / count)}", other / ours)


#: Relative times as printed; how they were measured, and for how many axes, is not.
SHARMA_TABLE_1 = {
    "covariance_intersection": 3.74,
    "inverse_covariance_intersection": 4.43,
    "ellipsoidal_intersection": 4.09,
    "harmonic_mean": 3.68,
}


def _table_1_of_sharma(count: int = 1000) -> Iterator[Result]:
    """Time each rule over naive fusion, pairs of two axes at weights that they find: for orientation, no target."""
    whole = _tracks(6, count, 2)
    tracks = SourceTracks(whole.mean[..., :2], whole.cov[..., :2, :2])
    rules = [get_rule(key) for key in ("naive", *SHARMA_TABLE_1)]
    naive, *times = race(*(lambda rule=rule: rule.fuse(tracks, rule.params()) for rule in rules))
    for rule, seconds in zip(rules[1:], times, strict=True):
        against = f"naive; Sharma, Table 1: {SHARMA_TABLE_1[rule.key]:g} x"
        yield Result(f"{rule.title}, 2 axes, {count} pairs", seconds / count, against, seconds / naive)


def _micro(seconds: float) -> str:
    return f"{seconds * 1e6:.3g} us"
