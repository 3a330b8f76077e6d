"""The loop of fusion with feedback: its order, and that trackers and a centre in it give the rows of the studies."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from track_fusion.centre.centre import FusionCentre
from track_fusion.centre.config import CentreConfig, FusionCentreParams, SourceConfig, TrackManagerParams
from track_fusion.filters.particle import SirParams
from track_fusion.params import Params
from track_fusion.rules import RULES
from track_fusion.scenarios.li2022 import linear, nonlinear
from track_fusion.study.one_target import COVARIANCE_FLOOR, drawn, fused_row, sir_filters
from track_fusion.study.scenario import RuleChoice, Tracking
from track_fusion.trackers.filters import FILTERS
from track_fusion.trackers.fusion_loop import fusion_loop
from track_fusion.trackers.one_target import SensorTracker, SensorTrackerParams
from track_fusion.tracks import SECOND_NS, TrackBatch

SEED, RUN, STEPS = 3, 4, 12


class Counting:
    """A participant that writes down what happens to it."""

    def __init__(self, name: str, log: list[Any]) -> None:
        self.name, self.log = name, log

    def step(self, scan: int) -> str:
        self.log.append((self.name, "step", scan))
        return f"{self.name}{scan}"

    def feed_back(self, fused: str) -> None:
        self.log.append((self.name, "fed", fused))


def test_all_step_then_one_fusion_then_all_are_fed() -> None:
    log: list[Any] = []

    def fuse(tracks: Sequence[str]) -> tuple[str, str]:
        log.append("fuse")
        return "+".join(tracks), f"({'+'.join(tracks)})"

    loop = fusion_loop([Counting("a", log), Counting("b", log)], [[(1,), (2,)], [(3,), (4,)]], fuse)
    assert next(loop) == "a1+b2"
    assert log == [("a", "step", 1), ("b", "step", 2), "fuse"]  # what is fed back waits for whoever reads the result
    assert next(loop) == "a3+b4"
    assert log[3:] == [("a", "fed", "(a1+b2)"), ("b", "fed", "(a1+b2)"), ("a", "step", 3), ("b", "step", 4), "fuse"]
    with pytest.raises(ValueError, match="zip"):
        next(fusion_loop([Counting("a", log)], [[(1,), (2,)]], fuse))


def sensor_trackers(tracking: Tracking, key: str, params: Params | None = None) -> list[SensorTracker]:
    """The trackers that the nodes would make of a scenario, each with a random stream of its own."""
    initial = SensorTrackerParams(
        initial_mean=tuple(tracking.initial_mean), initial_cov=tuple(tracking.initial_cov.ravel())
    )
    made = []
    for name, sensor in tracking.sensors.items():
        given = params or FILTERS[key].params()
        own = dataclasses.replace(given, role=f"sir {name}") if isinstance(given, SirParams) else given
        one = FILTERS[key].make(tracking.motion, sensor, own)
        made.append(SensorTracker(tracking.motion, sensor, one, "map", initial))
    return made


def centre(tracking: Tracking, choice: RuleChoice, variances: tuple[float, ...] = ()) -> FusionCentre:
    params = FusionCentreParams(gate_probability=0.999999, association="single_target", particle_variances=variances)
    sources, at_once = tuple(map(SourceConfig, tracking.sensors)), TrackManagerParams(confirmation_threshold=(1, 1))
    rule = RULES[choice.key]
    return FusionCentre(CentreConfig(sources, tracking.motion, "map", rule, choice.params, params, manager=at_once))


FLOOR = tuple(COVARIANCE_FLOOR * np.diag(nonlinear.TRACKING.initial_cov))
SIR = SirParams(seed=SEED, run=RUN, particles=60)
CI = next(c for c in linear.RULE_CHOICES if c.variant == "uniform")
AVERAGE = next(c for c in linear.RULE_CHOICES if c.key == "arithmetic_average")
JOINED = dataclasses.replace(AVERAGE, params=dataclasses.replace(AVERAGE.params, output="mixture"))
CASES = {
    "kalman": (linear.TRACKING, "kalman", None, AVERAGE, linear.KF, ()),
    "cubature": (nonlinear.TRACKING, "cubature", None, CI, nonlinear.CKF, ()),
    "particle": (nonlinear.TRACKING, "particle", SIR, CI, sir_filters(SIR), FLOOR),
    "particle_union": (nonlinear.TRACKING, "particle", SIR, JOINED, sir_filters(SIR), FLOOR),
}


@pytest.mark.parametrize("case", CASES)
def test_trackers_and_a_centre_in_the_loop_give_the_row_of_the_study(case: str) -> None:
    tracking, key, params, choice, filters, variances = CASES[case]
    tracking = dataclasses.replace(tracking, steps=STEPS)
    draws = drawn(tracking, [RUN], SEED)
    wanted = list(fused_row(tracking, filters, choice, join=case == "particle_union").estimates(draws))
    times = [round(k * tracking.dt_s * SECOND_NS) for k in range(1, STEPS + 1)]
    fuser = centre(tracking, choice, variances)

    def fuse(tracks: Sequence[TrackBatch]) -> tuple[TrackBatch, TrackBatch]:
        fused, _ = fuser.step(int(tracks[0].time_ns[0]), dict(enumerate(tracks)))
        return fused, fused

    scans = ([(time_ns, z[0, k : k + 1], None) for z in draws.seen] for k, time_ns in enumerate(times))
    results = list(fusion_loop(sensor_trackers(tracking, key, params), scans, fuse))
    assert len(results) == STEPS
    for batch, row in zip(results, wanted, strict=True):
        mean, cov = batch.moments
        np.testing.assert_allclose(mean[0], row.mean[0], rtol=1e-9, atol=1e-9)
        if case != "particle_union":  # whose row claims the rule's Gaussian
            np.testing.assert_allclose(cov[0], row.cov[0], rtol=1e-8, atol=1e-9)
