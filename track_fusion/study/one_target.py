"""One target seen by sensors with a filter each, whose posteriors are fused and fed back: what Li 2022 studies.

Every row of a table is an iterator of posteriors over the steps, batched over Monte Carlo runs; what a study keeps of
them is collected by one_target_study.py.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from track_fusion.filters import iterated_corrector, particle
from track_fusion.filters.iterated_corrector import GaussianUpdate
from track_fusion.filters.particle import Particles
from track_fusion.linalg import Array
from track_fusion.models.base import Transition
from track_fusion.random_streams import stream
from track_fusion.rules import RULES, FusedTracks, SourceTracks
from track_fusion.rules.arithmetic_average import ArithmeticAverageParams
from track_fusion.rules.covariance_intersection import CovarianceIntersectionParams
from track_fusion.rules.covariance_union import CovarianceUnionParams
from track_fusion.rules.naive import NaiveParams
from track_fusion.study.rule_choice import RuleChoice, fuse_runs
from track_fusion.study.scene import Tracking

#: Particles of so many runs are worked on at once: larger arrays leave the cache.
SIR_CHUNK = 50
#: What is added to the covariance of particles turned into a Gaussian, as a share of the initial variances: particles
#: that have collapsed onto a few points have a singular one.
COVARIANCE_FLOOR = 1e-9

#: The rules of section IV. Covariance union is a bound of all P_i + (x - x_i)(x - x_i)' about the arithmetic average,
#: about the mean at which that bound is least, or, as eq. (8) is printed, the one of them with the largest trace.
RULE_CHOICES = (
    RuleChoice("naive", NaiveParams()),
    RuleChoice("arithmetic_average", ArithmeticAverageParams(criterion="diversity")),
    RuleChoice("covariance_intersection", CovarianceIntersectionParams(criterion="trace")),
    RuleChoice("covariance_intersection", CovarianceIntersectionParams(criterion="uniform"), "uniform"),
    RuleChoice("covariance_union", CovarianceUnionParams(criterion="det", mean="diversity")),
    RuleChoice("covariance_union", CovarianceUnionParams(criterion="det", mean="optimal"), "optimal_mean"),
    RuleChoice("covariance_union", CovarianceUnionParams(bound="max_trace", mean="diversity"), "max_trace"),
)


class GaussianFilter(NamedTuple):
    """A filter of means and covariances: its predict and update, as of filters/cubature.py."""

    predict: Callable[[Array, Array, Transition], tuple[Array, Array]]
    update: GaussianUpdate


class Draws(NamedTuple):
    """Monte Carlo runs: which, and what each sensor saw in them, (R, T, m) each."""

    seed: int
    runs: Sequence[int]
    seen: Sequence[Array]


class Row(NamedTuple):
    """A row of a table: posteriors step by step, of so many runs at a time (0: of all).

    They are mean (R, n), cov (R, n, n) or, where all runs share it, (1, n, n), and of fused tracks the fusion weights
    (R, K) or (1, K).
    """

    estimates: Callable[[Draws], Iterator[FusedTracks]]
    chunk: int = 0


def start(tracking: Tracking, runs: int) -> tuple[Array, Array]:
    """Every run's initial mean (R, n) and covariance (R, n, n)."""
    return np.tile(tracking.initial_mean, (runs, 1)), np.tile(tracking.initial_cov, (runs, 1, 1))


def gaussian_alone(tracking: Tracking, one: GaussianFilter, sensors: int) -> Row:
    """One filter that uses the first so many sensors, one after the other (IC)."""

    def estimates(draws: Draws) -> Iterator[FusedTracks]:
        used = list(tracking.sensors.values())[:sensors]
        mean, cov = start(tracking, len(draws.runs))
        for k in range(tracking.steps):
            mean, cov = one.predict(mean, cov, tracking.motion.over(tracking.dt_s))
            zs = [z[:, k] for z in draws.seen[:sensors]]
            mean, cov, _ = iterated_corrector.update(mean, cov, zs, used, one.update)
            yield FusedTracks(mean, cov)

    return Row(estimates)


def gaussian_fused(tracking: Tracking, one: GaussianFilter, choice: RuleChoice) -> Row:
    """One filter a sensor, fused after each step, the fused posterior fed back to all of them."""

    def estimates(draws: Draws) -> Iterator[FusedTracks]:
        rngs, (mean, cov) = fusion_streams(draws), start(tracking, len(draws.runs))
        for k in range(tracking.steps):
            mean, cov = one.predict(mean, cov, tracking.motion.over(tracking.dt_s))
            pairs = zip(draws.seen, tracking.sensors.values(), strict=True)
            local = [one.update(mean, cov, z[:, k], sensor)[:2] for z, sensor in pairs]
            means, covs = (np.stack(parts, 1) for parts in zip(*local, strict=True))
            fused = fuse_runs(choice, means, covs, rngs)
            mean, cov = fused.mean, fused.cov
            yield fused

    return Row(estimates)


def fusion_streams(draws: Draws) -> list[np.random.Generator]:
    """Return what a rule that samples draws from, a generator a run."""
    return [stream(draws.seed, run, "fusion_centre") for run in draws.runs]


@dataclasses.dataclass(frozen=True)
class Sir:
    """A sampling-importance-resampling filter: number of particles and way of resampling."""

    count: int
    resampling: str = "systematic"


def _streams(draws: Draws, name: str) -> list[np.random.Generator]:
    return [stream(draws.seed, run, f"sir {name}") for run in draws.runs]


def sir_alone(tracking: Tracking, sir: Sir, sensors: int) -> Row:
    """One particle filter weighted by the first so many sensors (IC), resampled after every step."""

    def estimates(draws: Draws) -> Iterator[FusedTracks]:
        used, rng = list(tracking.sensors.values())[:sensors], _streams(draws, next(iter(tracking.sensors)))
        cloud = particle.from_gaussian(*start(tracking, len(draws.runs)), rng, sir.count)
        for k in range(tracking.steps):
            cloud = particle.predict(cloud, tracking.motion.over(tracking.dt_s), rng)
            for z, sensor in zip(draws.seen, used, strict=False):
                cloud, _ = particle.update(cloud, z[:, k], sensor)
            yield FusedTracks(*particle.moments(cloud))
            cloud = particle.RESAMPLING[sir.resampling](cloud, rng, sir.count)

    return Row(estimates, SIR_CHUNK)


def sir_fused(tracking: Tracking, sir: Sir, choice: RuleChoice, union: bool = False) -> Row:
    """One particle filter a sensor, fused after each step and drawn again, each by itself, from what was fused.

    The rule fuses the particles' Gaussian conversions. With `union` its weights join the particles
    themselves: the arithmetic average of their densities.
    """

    def estimates(draws: Draws) -> Iterator[FusedTracks]:
        streams = [_streams(draws, name) for name in tracking.sensors]
        clouds = [particle.from_gaussian(*start(tracking, len(draws.runs)), rng, sir.count) for rng in streams]
        for k in range(tracking.steps):
            moved = [
                particle.predict(cloud, tracking.motion.over(tracking.dt_s), rng)
                for cloud, rng in zip(clouds, streams, strict=True)
            ]
            triples = zip(moved, draws.seen, tracking.sensors.values(), strict=True)
            clouds = [particle.update(cloud, z[:, k], sensor)[0] for cloud, z, sensor in triples]
            fused = RULES[choice.key].fuse(_converted(tracking, clouds), choice.params)
            yield fused
            clouds = [_drawn_again(clouds, fused, rng, sir, union) for rng in streams]

    return Row(estimates, SIR_CHUNK)


def sir_rows(tracking: Tracking, sir: Sir, choices: Sequence[RuleChoice]) -> dict[str, Row]:
    """Every row by particle filters; the arithmetic average joins the particles, or (@gaussian) their Gaussians.

    Without fusion also by multinomial resampling, whose draws are independent and add more noise.
    """
    table = {"sir-alone": sir_alone(tracking, sir, 1), "sir-ic": sir_alone(tracking, sir, 2)}
    noisier = dataclasses.replace(sir, resampling="multinomial")
    table |= {f"{row}@multinomial": sir_alone(tracking, noisier, i) for i, row in enumerate(list(table), 1)}
    for choice in choices:
        averaged = choice.key == "arithmetic_average"
        table[f"sir-{choice.name}"] = sir_fused(tracking, sir, choice, union=averaged)
        if averaged:
            table[f"sir-{choice.name}@gaussian"] = sir_fused(tracking, sir, choice)
    return table


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


def drawn(tracking: Tracking, runs: Sequence[int], seed: int) -> tuple[Array, Draws]:
    """Draw the truth (R, T + 1, n) and the measurements of these Monte Carlo runs."""
    truth = tracking.truths(seed, runs)
    seen = [tracking.measurements(states, seed, run) for states, run in zip(truth, runs, strict=True)]
    return truth, Draws(seed, runs, [np.stack([s[name] for s in seen]) for name in tracking.sensors])
