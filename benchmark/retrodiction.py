"""A rewind of the fusion centre for a late scan, against the steps that it repeats."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmark.measure import Result, race
from track_fusion.centre.config import CentreConfig, FusionCentreParams, IdentityParams, ScanBufferParams, SourceConfig
from track_fusion.centre.history import History, Late, forward, rewind
from track_fusion.centre.state import CentreState
from track_fusion.centre.step import step
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.rules import RULES
from track_fusion.tracks import TrackBatch, planar_layout

STEP_NS = 100_000_000
#: Steps that a rewind repeats.
BACK = 10


def run() -> Iterator[Result]:
    """Measure rewinds at few and many tracks."""
    for count in (1, 20, 1000):
        yield from _rewind(count)


def _config(out_of_sequence: str) -> CentreConfig:
    rule, sources = RULES["covariance_intersection"], (SourceConfig("sensor_1"), SourceConfig("sensor_2"))
    motion = NearlyConstantVelocity(planar_layout(), MotionParams())
    params, buffer = FusionCentreParams(memory=True), ScanBufferParams(out_of_sequence=out_of_sequence)
    identity = IdentityParams("retrodiction")
    return CentreConfig(sources, motion, "map", rule, rule.params(), params, buffer=buffer, identity=identity)


def _scan(rng: np.random.Generator, count: int, time_ns: int) -> TrackBatch:
    """Targets at rest, 20 m apart."""
    mean = np.zeros((count, 4))
    mean[:, 0] = 20.0 * np.arange(count)
    mean += 0.1 * rng.normal(size=mean.shape)
    return TrackBatch.gaussian(planar_layout(), "map", mean, np.tile(np.eye(4), (count, 1, 1)), time_ns=time_ns)


def _rewind(count: int) -> Iterator[Result]:
    """Put the second source's scan into the first of ten steps; and what remembering costs a step."""
    rng = np.random.default_rng(count)
    own, plain = _config("retrodict"), _config("predict")
    history, late_ns = History.of(CentreState.initial(own)), 5 * STEP_NS
    scans = {}
    for k in range(1, 5 + BACK):
        time_ns = k * STEP_NS
        both = {source: _scan(rng, count, time_ns) for source in (0, 1)}
        late = both[1]
        scans[time_ns] = {0: both[0]} if time_ns == late_ns else both
        if time_ns == late_ns:
            missing = Late(1, late, time_ns)
        history, *_ = forward(own, history, time_ns, scans[time_ns])
    start = next(kept.before.state for kept in history.kept if kept.time_ns == late_ns)

    def repeat() -> None:
        state = start
        for time_ns, new in scans.items():
            if time_ns >= late_ns:
                state, *_ = step(own, state, time_ns, new)

    next_ns = history.present.state.time_ns + STEP_NS
    new = {source: _scan(rng, count, next_ns) for source in (0, 1)}
    rewound, steps, remembered, forgotten = race(
        lambda: rewind(own, history, [missing]),
        repeat,
        lambda: forward(own, history, next_ns, new),
        lambda: forward(plain, history, next_ns, new),
    )
    tracks = f"{count} track{'s' * (count > 1)}, 2 sources"
    yield Result(f"a rewind of {BACK} steps, {tracks}", rewound, f"{BACK} steps, {steps * 1e3:.3g} ms", rewound / steps,
                 at_most=1.25)  # fmt: skip
    yield Result(f"a step that is remembered, {tracks}", remembered, f"one that is not, {forgotten * 1e3:.3g} ms",
                 remembered / forgotten, at_most=1.25)  # fmt: skip
