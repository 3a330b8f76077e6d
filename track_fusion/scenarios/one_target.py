"""One target seen by sensors with a filter each, whose posteriors are fused and fed back: what Li 2022 studies.

Every row of a table is an iterator of estimates over the steps, batched over Monte Carlo runs; errors are
collected by :func:`squared_errors`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from track_fusion.filters import iterated_corrector, particle
from track_fusion.filters.iterated_corrector import GaussianUpdate
from track_fusion.filters.particle import Particles
from track_fusion.linalg import Array
from track_fusion.metrics.accuracy import rmse
from track_fusion.models.base import Transition
from track_fusion.random_streams import stream
from track_fusion.report.chart import Chart, Series
from track_fusion.rules import RULES, FusedTracks, SourceTracks
from track_fusion.scenarios.base import Progress, RuleChoice, Samples, Tracking

#: Particles of so many runs are worked on at once: larger arrays leave the cache.
SIR_CHUNK = 50
#: What is added to the covariance of particles turned into a Gaussian, as a share of the initial variances: particles
#: that have collapsed onto a few points have a singular one.
COVARIANCE_FLOOR = 1e-9


class GaussianFilter(NamedTuple):
    """A filter of means and covariances: its predict and update, as of filters/cubature.py."""

    predict: Callable[[Array, Array, Transition], tuple[Array, Array]]
    update: GaussianUpdate


class Sample(NamedTuple):
    """Monte Carlo runs: which, and what each sensor saw in them, (R, T, m) each."""

    seed: int
    runs: Sequence[int]
    seen: Sequence[Array]


class Row(NamedTuple):
    """A row of a table: estimated means (R, n) step by step of so many runs at a time (0: of all)."""

    estimates: Callable[[Sample], Iterator[Array]]
    chunk: int = 0


class Quantity(NamedTuple):
    """The norm of some axes of the error, in a unit of its own."""

    axes: tuple[int, ...]
    factor: float = 1.0


def start(tracking: Tracking, runs: int) -> tuple[Array, Array]:
    """Every run's initial mean (R, n) and covariance (R, n, n)."""
    return np.tile(tracking.initial_mean, (runs, 1)), np.tile(tracking.initial_cov, (runs, 1, 1))


def gaussian_alone(tracking: Tracking, one: GaussianFilter, sensors: int) -> Row:
    """One filter that uses the first so many sensors, one after the other (IC)."""

    def estimates(sample: Sample) -> Iterator[Array]:
        used = list(tracking.sensors.values())[:sensors]
        mean, cov = start(tracking, len(sample.runs))
        for k in range(tracking.steps):
            mean, cov = one.predict(mean, cov, tracking.motion.over(tracking.dt_s))
            zs = [z[:, k] for z in sample.seen[:sensors]]
            mean, cov, _ = iterated_corrector.update(mean, cov, zs, used, one.update)
            yield mean

    return Row(estimates)


def gaussian_fused(tracking: Tracking, one: GaussianFilter, choice: RuleChoice) -> Row:
    """One filter a sensor, fused after each step, the fused posterior fed back to all of them."""
    return Row(lambda sample: (fused.mean for fused in gaussian_fusions(tracking, one, choice, sample)))


def gaussian_fusions(
    tracking: Tracking, one: GaussianFilter, choice: RuleChoice, sample: Sample
) -> Iterator[FusedTracks]:
    """Yield what the rule gives at each step of :func:`gaussian_fused`, weights included."""
    mean, cov = start(tracking, len(sample.runs))
    for k in range(tracking.steps):
        mean, cov = one.predict(mean, cov, tracking.motion.over(tracking.dt_s))
        pairs = zip(sample.seen, tracking.sensors.values(), strict=True)
        local = [one.update(mean, cov, z[:, k], sensor)[:2] for z, sensor in pairs]
        tracks = SourceTracks(np.stack([m for m, _ in local], 1), np.stack([c for _, c in local], 1))
        fused = RULES[choice.key].fuse(tracks, choice.params)
        mean, cov = fused.mean, fused.cov
        yield fused


@dataclasses.dataclass(frozen=True)
class Sir:
    """A sampling-importance-resampling filter: number of particles and way of resampling."""

    count: int
    resampling: str = "systematic"


def _streams(sample: Sample, name: str) -> list[np.random.Generator]:
    return [stream(sample.seed, run, f"sir {name}") for run in sample.runs]


def sir_alone(tracking: Tracking, sir: Sir, sensors: int) -> Row:
    """One particle filter weighted by the first so many sensors (IC), resampled after every step."""

    def estimates(sample: Sample) -> Iterator[Array]:
        used, rng = list(tracking.sensors.values())[:sensors], _streams(sample, next(iter(tracking.sensors)))
        cloud = particle.from_gaussian(*start(tracking, len(sample.runs)), rng, sir.count)
        for k in range(tracking.steps):
            cloud = particle.predict(cloud, tracking.motion.over(tracking.dt_s), rng)
            for z, sensor in zip(sample.seen, used, strict=False):
                cloud, _ = particle.update(cloud, z[:, k], sensor)
            yield particle.moments(cloud)[0]
            cloud = particle.RESAMPLING[sir.resampling](cloud, rng, sir.count)

    return Row(estimates, SIR_CHUNK)


def sir_fused(tracking: Tracking, sir: Sir, choice: RuleChoice, union: bool = False) -> Row:
    """One particle filter a sensor, fused after each step and drawn again, each by itself, from what was fused.

    The rule fuses the particles' Gaussian conversions. With `union` its weights join the particles
    themselves: the arithmetic average of their densities.
    """

    def estimates(sample: Sample) -> Iterator[Array]:
        streams = [_streams(sample, name) for name in tracking.sensors]
        clouds = [particle.from_gaussian(*start(tracking, len(sample.runs)), rng, sir.count) for rng in streams]
        for k in range(tracking.steps):
            moved = [
                particle.predict(cloud, tracking.motion.over(tracking.dt_s), rng)
                for cloud, rng in zip(clouds, streams, strict=True)
            ]
            triples = zip(moved, sample.seen, tracking.sensors.values(), strict=True)
            clouds = [particle.update(cloud, z[:, k], sensor)[0] for cloud, z, sensor in triples]
            fused = RULES[choice.key].fuse(_converted(tracking, clouds), choice.params)
            yield fused.mean
            clouds = [_drawn_again(clouds, fused, rng, sir, union) for rng in streams]

    return Row(estimates, SIR_CHUNK)


def _converted(tracking: Tracking, clouds: Sequence[Particles]) -> SourceTracks:
    moments = [particle.moments(cloud) for cloud in clouds]
    floor = COVARIANCE_FLOOR * np.diag(np.diagonal(tracking.initial_cov))
    return SourceTracks(np.stack([m for m, _ in moments], 1), np.stack([c + floor for _, c in moments], 1))


def _drawn_again(
    clouds: Sequence[Particles], fused: FusedTracks, rng: list[np.random.Generator], sir: Sir, union: bool
) -> Particles:
    if not union:
        return particle.from_gaussian(fused.mean, fused.cov, rng, sir.count)
    assert fused.weights is not None
    return particle.RESAMPLING[sir.resampling](particle.union(clouds, fused.weights), rng, sir.count)


def drawn(tracking: Tracking, runs: Sequence[int], seed: int) -> tuple[Array, Sample]:
    """Draw the truth (R, T + 1, n) and the measurements of these Monte Carlo runs."""
    truth = tracking.truths(seed, runs)
    seen = [tracking.measurements(states, seed, run) for states, run in zip(truth, runs, strict=True)]
    return truth, Sample(seed, runs, [np.stack([s[name] for s in seen]) for name in tracking.sensors])


def squared_errors(
    tracking: Tracking,
    rows: Mapping[str, Row],
    quantities: Mapping[str, Quantity],
    runs: Sequence[int],
    seed: int,
    progress: Progress,
) -> dict[str, Array]:
    """Run every row over the same Monte Carlo runs.

    Returns
    -------
    {row/quantity: squared norm of the error (R, T)}
    """
    truth, sample = drawn(tracking, runs, seed)
    found: dict[str, Array] = {}
    for done, (name, row) in enumerate(rows.items()):
        names, step = [f"{name}/{q}" for q in quantities], row.chunk or len(runs)
        found |= {full: np.empty((len(runs), tracking.steps)) for full in names}
        for begin in range(0, len(runs), step):
            part = slice(begin, min(begin + step, len(runs)))
            for k, mean in enumerate(row.estimates(Sample(seed, runs[part], [z[part] for z in sample.seen]))):
                error = mean - truth[part, k + 1]
                for full, quantity in zip(names, quantities.values(), strict=True):
                    found[full][part, k] = ((error[:, quantity.axes] * quantity.factor) ** 2).sum(1)
                share = (begin + (part.stop - begin) * (k + 1) / tracking.steps) / len(runs)
                progress((done + share) / len(rows))
    return found


def charts(samples: Samples) -> list[Chart]:
    """Root-mean-square error over the steps, one chart a filter and quantity."""
    groups: dict[tuple[str, str], list[Series]] = {}
    for name, squares in samples.items():
        row, _, quantity = name.rpartition("/")
        one, _, rule = row.partition("-")
        steps = np.arange(1, squares.shape[1] + 1)
        groups.setdefault((one, quantity), []).append(Series(rule, steps, rmse(squares)))
    return [
        Chart(
            f"{one.upper()}: {quantity.replace('_armse_', ' RMSE, ')}",
            "step",
            quantity.rpartition("_")[2],
            tuple(lines),
        )
        for (one, quantity), lines in groups.items()
    ]
