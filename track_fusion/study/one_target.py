"""One target seen by sensors with a filter each, whose posteriors are fused and fed back: what Li 2022 studies.

Every row of a table is an iterator of posteriors over the steps, batched over Monte Carlo runs; what a study keeps of
them is collected by one_target_study.py.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from track_fusion.filters.base import Density, Gaussian, TrackFilter, TrackState
from track_fusion.filters.iterated_corrector import IteratedCorrector
from track_fusion.filters.particle import Particles, Sir, SirParams, union
from track_fusion.linalg import Array
from track_fusion.models.base import Transition
from track_fusion.random_streams import stream
from track_fusion.rules import FusedTracks
from track_fusion.study.rule_choice import RuleChoice, fuse_runs
from track_fusion.study.scene import Tracking
from track_fusion.trackers.fusion_loop import BatchTracker, filtered, fusion_loop

#: Particles of so many runs are worked on at once: larger arrays leave the cache.
SIR_CHUNK = 50
#: What is added to the covariance of particles turned into a Gaussian, as a share of the initial variances: particles
#: that have collapsed onto a few points have a singular one.
COVARIANCE_FLOOR = 1e-9

#: The rules of section IV. Covariance union is a bound of all P_i + (x - x_i)(x - x_i)' about the arithmetic average,
#: about the mean at which that bound is least, or, as eq. (8) is printed, the one of them with the largest trace.
RULE_CHOICES = (
    RuleChoice.of("naive"),
    RuleChoice.of("arithmetic_average", criterion="diversity"),
    RuleChoice.of("covariance_intersection", criterion="trace"),
    RuleChoice.of("covariance_intersection", "uniform", criterion="uniform"),
    RuleChoice.of("covariance_union", criterion="det", mean="diversity"),
    RuleChoice.of("covariance_union", "optimal_mean", criterion="det", mean="optimal"),
    RuleChoice.of("covariance_union", "max_trace", bound="max_trace", mean="diversity"),
)


class Draws(NamedTuple):
    """What is drawn in R Monte Carlo runs: the truth (R, T + 1, n), and what each sensor saw, (R, T, m) each."""

    seed: int
    runs: Sequence[int]
    truth: Array
    seen: Sequence[Array]

    def part(self, rows: slice) -> Draws:
        """Return some of the runs."""
        return Draws(self.seed, self.runs[rows], self.truth[rows], [z[rows] for z in self.seen])


def drawn(tracking: Tracking, runs: Sequence[int], seed: int) -> Draws:
    """Draw the truth and the measurements of these Monte Carlo runs."""
    truth = tracking.truths(seed, runs)
    seen = [tracking.measurements(states, seed, run) for states, run in zip(truth, runs, strict=True)]
    return Draws(seed, runs, truth, [np.stack([z[name] for z in seen]) for name in tracking.sensors])


class Row(NamedTuple):
    """A row of a table: posteriors step by step, of so many runs at a time (0: of all).

    They are mean (R, n), cov (R, n, n) or, where all runs share it, (1, n, n), and of fused tracks the fusion weights
    (R, K) or (1, K).
    """

    estimates: Callable[[Draws], Iterator[FusedTracks]]
    chunk: int = 0


class Filters(NamedTuple):
    """The filters of a row.

    Attributes
    ----------
    of : callable    (draws, name of a sensor) -> its filter
    alike : bool     all sensors have the same, which draws no random numbers
    chunk : int      runs that they work on at once; 0: all
    """

    of: Callable[[Draws, str], TrackFilter[Any, Transition, Array, Any, Any]]
    alike: bool
    chunk: int = 0


def same_filters(one: TrackFilter[Gaussian, Transition, Array, Any, Any]) -> Filters:
    """Give all sensors one filter, which draws no random numbers."""
    return Filters(lambda draws, name: one, alike=True)


def sir_filters(params: SirParams, periods: Sequence[float] = ()) -> Filters:
    """Give each sensor a particle filter with a stream of its own in each run."""

    def of(draws: Draws, name: str) -> Sir:
        return Sir(dataclasses.replace(params, seed=draws.seed, role=f"sir {name}"), tuple(draws.runs), periods)

    return Filters(of, alike=False, chunk=SIR_CHUNK)


def _start(tracking: Tracking, runs: int) -> tuple[Array, Array]:
    """Mean (R, n) and covariance (1, n, n) of every run at the start: all share the covariance."""
    return np.tile(tracking.initial_mean, (runs, 1)), tracking.initial_cov[None]


def alone_row(tracking: Tracking, filters: Filters, sensors: int) -> Row:
    """One filter that uses the first so many sensors, one after the other (IC)."""

    def estimates(draws: Draws) -> Iterator[FusedTracks]:
        one = filters.of(draws, next(iter(tracking.sensors)))
        scans = ([z[:, k] for z in draws.seen[:sensors]] for k in range(tracking.steps))
        used, transition = list(tracking.sensors.values())[:sensors], tracking.motion.over(tracking.dt_s)
        start = one.begin(*_start(tracking, len(draws.runs)))
        for state in filtered(IteratedCorrector(one), start, transition, scans, used):
            yield FusedTracks(*state.moments)

    return Row(estimates, filters.chunk)


def fused_row(tracking: Tracking, filters: Filters, choice: RuleChoice, join: bool = False) -> Row:
    """One filter a sensor, fused after each step, the fused posterior fed back to all of them.

    The rule fuses the filters' moments. With `join` its weights join the particles themselves: the arithmetic average
    of their densities, from which each filter draws by itself.
    """

    def estimates(draws: Draws) -> Iterator[FusedTracks]:
        rngs = [stream(draws.seed, run, "fusion_centre") for run in draws.runs] if choice.random else None

        def fuse(tracks: Sequence[Sequence[TrackState]]) -> tuple[FusedTracks, Density]:
            states = [state for each in tracks for state in each]
            means, covs = (np.stack(part, 1) for part in zip(*(_moments(tracking, s) for s in states), strict=True))
            fused = fuse_runs(choice, means, covs, rngs, float(states[0].dof), tracking.layout.periods)
            if not join:
                return fused, Gaussian(fused.mean, fused.cov)
            assert fused.weights is not None
            return fused, union([s for s in states if isinstance(s, Particles)], fused.weights)

        names, every = list(tracking.sensors), list(tracking.sensors.values())
        start, transition = _start(tracking, len(draws.runs)), tracking.motion.over(tracking.dt_s)
        groups = [slice(None)] if filters.alike else [slice(k, k + 1) for k in range(len(names))]
        ones = [filters.of(draws, names[group][0]) for group in groups]
        trackers = [
            BatchTracker(one, one.begin(*start), transition, every[group])
            for one, group in zip(ones, groups, strict=True)
        ]
        scans = ([[z[:, k] for z in draws.seen[group]] for group in groups] for k in range(tracking.steps))
        return fusion_loop(trackers, scans, fuse)

    return Row(estimates, filters.chunk)


def _moments(tracking: Tracking, state: TrackState) -> tuple[Array, Array]:
    mean, cov = state.moments
    if isinstance(state, Particles):
        cov = cov + COVARIANCE_FLOOR * np.diag(np.diagonal(tracking.initial_cov))
    return mean, cov


def gaussian_rows(name: str, tracking: Tracking, filters: Filters, choices: Sequence[RuleChoice]) -> dict[str, Row]:
    """Every row by filters of this name: sensor 1 alone, both in one filter (ic), and each rule."""
    table = {f"{name}-alone": alone_row(tracking, filters, 1), f"{name}-ic": alone_row(tracking, filters, 2)}
    return table | {f"{name}-{choice.name}": fused_row(tracking, filters, choice) for choice in choices}


def sir_rows(tracking: Tracking, sir: SirParams, choices: Sequence[RuleChoice]) -> dict[str, Row]:
    """Every row by particle filters; the arithmetic average joins the particles, or (@gaussian) their Gaussians.

    Without fusion also by multinomial resampling, whose draws are independent and add more noise.
    """
    periods = tracking.layout.periods
    filters = sir_filters(sir, periods)
    noisier = sir_filters(dataclasses.replace(sir, resampling="multinomial"), periods)
    table = {"sir-alone": alone_row(tracking, filters, 1), "sir-ic": alone_row(tracking, filters, 2)}
    table |= {f"{row}@multinomial": alone_row(tracking, noisier, i) for i, row in enumerate(list(table), 1)}
    for choice in choices:
        averaged = choice.key == "arithmetic_average"
        table[f"sir-{choice.name}"] = fused_row(tracking, filters, choice, join=averaged)
        if averaged:
            table[f"sir-{choice.name}@gaussian"] = fused_row(tracking, filters, choice)
    return table
