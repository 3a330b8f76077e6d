"""A Monte Carlo study, 1000 runs x 100 steps of li2022-linear, against the same filters looped over runs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmark.baselines import two_filters_and_intersection_looped
from benchmark.measure import Result, race
from track_fusion.scenarios.li2022.linear import KF, RULE_CHOICES, TRACKING
from track_fusion.study.one_target import drawn, fused_row

RUNS = 1000
#: The loop is timed on so many runs and scaled up.
SAMPLE = 3


def run() -> Iterator[Result]:
    """Measure the rows of covariance intersection, measurements given: two filters, the rule, feedback."""
    draws = drawn(TRACKING, range(RUNS), 1)
    sensors, motion = list(TRACKING.sensors.values()), TRACKING.motion.matrices(TRACKING.dt_s)
    for choice in RULE_CHOICES:
        if choice.key != "covariance_intersection":
            continue
        weight = 0.5 if choice.variant == "uniform" else None

        def study(choice=choice):
            return [fused.mean for fused in fused_row(TRACKING, KF, choice).estimates(draws)]

        def loop(weight=weight):
            return two_filters_and_intersection_looped(
                TRACKING.initial_mean, TRACKING.initial_cov, *motion,
                sensors[0].matrix, [s.noise for s in sensors], [z[:SAMPLE] for z in draws.seen], weight,
            )  # fmt: skip

        _check(study(), loop(), weight)
        ours, users = race(study, loop)
        users *= RUNS / SAMPLE
        how = "weight 1/2" if weight else "minimize_scalar of the trace"
        yield Result(f"{RUNS} runs, {choice.name}", ours, f"looped, {how}, {users:.3g} s", users / ours, at_least=35.0)


def _check(study: list[np.ndarray], loop: np.ndarray, weight: float | None) -> None:
    """Both do the same work: their estimates agree, as far as the optimiser of the loop goes."""
    np.testing.assert_allclose(np.stack(study, 1)[:SAMPLE], loop, atol=1e-6 if weight else 1.0)
