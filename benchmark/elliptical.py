"""Means of covariances against pyriemann, and the rules for elliptical tracks against what users would write."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from benchmark import baselines
from benchmark.measure import Result, race
from track_fusion.densities.elliptical.spd_means import karcher_mean, log_euclidean_mean
from track_fusion.rules import SourceTracks, get_rule

AXES = 6
#: A baseline is timed on so many jobs of the batch and scaled up: it is a loop.
SAMPLE = 25


def run() -> Iterator[Result]:
    """Measure the two means of five 6 x 6 covariances, and fusions of two and of five tracks."""
    try:
        yield from _means()
    except ImportError as error:
        yield Result("Karcher and log-Euclidean mean", against=f"skipped: {error}")
    yield from _projections()
    yield from _others()


def _tracks(seed: int, count: int, sources: int) -> SourceTracks:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(count, sources, AXES, AXES + 2))
    mean, dof = rng.normal(size=(count, sources, AXES)), np.full((count, sources), 5.0)
    return SourceTracks(mean, root @ np.swapaxes(root, -1, -2), dof)


def _means(count: int = 1000) -> Iterator[Result]:
    covs = _tracks(1, count, 5).cov
    sample = covs[:SAMPLE]
    jobs: list[tuple[str, Callable[[], object], Callable[[], object], float | None]] = [
        ("Karcher", lambda: karcher_mean(covs), lambda: baselines.karcher_pyriemann(sample), 4.0),
        ("Log-Euclidean", lambda: log_euclidean_mean(covs), lambda: baselines.log_euclidean_pyriemann(sample), None),
    ]
    for name, ours_job, job, target in jobs:
        ours, users, floor = race(ours_job, job, lambda: np.linalg.eigh(covs))
        ours, users, floor = ours / count, users / SAMPLE, floor / count
        title = f"{name} mean of five, {count} groups"
        yield Result(title, ours, f"pyriemann, {_micro(users)}", users / ours, at_least=target)
        yield Result(title, ours, f"one eigh of the five, {_micro(floor)}", ours / floor)
    one = covs[:1]
    ours, users = race(lambda: karcher_mean(one), lambda: baselines.karcher_pyriemann(one))
    yield Result("Karcher mean of five, one group", ours, f"pyriemann, {_micro(users)}", users / ours)


def _projections(sample: int = 10) -> Iterator[Result]:
    rule = get_rule("mhdp_iterative")
    for count, sources in ((1000, 2), (1000, 5)):
        tracks = _tracks(2, count, sources)

        def loop(tracks: SourceTracks = tracks) -> None:
            for means, covs in zip(tracks.mean[:sample], tracks.cov[:sample], strict=True):
                baselines.mhdp_mean_minimize(means, covs, 1.0 / AXES)

        ours, users = race(lambda tracks=tracks: rule.fuse(tracks, rule.params()), loop)
        ours, users = ours / count, users / sample
        name = f"MHDP-I of {sources} tracks, {count} fusions"
        yield Result(name, ours, f"BFGS for its mean alone, {_micro(users)}", users / ours)


def _others(count: int = 200) -> Iterator[Result]:
    """Time the other rules beside covariance intersection, for orientation."""
    tracks = _tracks(3, count, 3)
    reference = get_rule("covariance_intersection")
    for key in ("mhdp_explicit", "geodesic_projection", "quasi_minimal_manhattan"):
        rule = get_rule(key)
        ours, other = race(
            lambda rule=rule: rule.fuse(tracks, rule.params()), lambda: reference.fuse(tracks, reference.params())
        )
        yield Result(f"{rule.title}, {count} of 3", ours / count, f"CI, {_micro(other / count)}", other / ours)


def _micro(seconds: float) -> str:
    return f"{seconds * 1e6:.3g} us"
