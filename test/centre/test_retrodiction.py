"""A centre that retrodicts, fed with scans and times: late sources, the share of the time, what readers see."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from track_fusion.centre.centre import FusionCentre, Published
from track_fusion.centre.config import (
    CentreConfig,
    FusionCentreParams,
    IdentityParams,
    ScanBufferParams,
    SourceConfig,
)
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.rules import RULES
from track_fusion.tracks import TrackBatch, planar_layout

MS, SECOND = 10**6, 10**9
LAYOUT = planar_layout()
RULE = RULES["naive"]  # every scan leaves a trace in the memory
STEPS, PROMPT_STEPS = 40, 60
#: The second source's scans come so late.
DELAY_NS = 250 * MS


def centre(timer: Callable[[], float] = lambda: 0.0, **buffer: Any) -> FusionCentre:
    """A centre whose rewinds take no time unless a timer says so."""
    motion = NearlyConstantVelocity(LAYOUT, MotionParams(process_noise=1.0))
    sources = SourceConfig("prompt"), SourceConfig("late")
    buffer = ScanBufferParams(**{"out_of_sequence": "retrodict"} | buffer)
    config = CentreConfig(
        sources, motion, "map", RULE, RULE.params(), FusionCentreParams(memory=True), buffer=buffer,
        identity=IdentityParams("retrodiction"),
    )  # fmt: skip
    return FusionCentre(config, timer)


def scan(source: int, k: int) -> TrackBatch:
    """Two targets that move, as a source sees them."""
    rng = np.random.default_rng((source, k))
    mean = np.array([[0.1 * k, 0.0, 1.0, 0.0], [300.0, 0.1 * k, 0.0, 1.0]]) + rng.normal(0, 0.3, (2, 4))
    cov = np.tile(np.diag([1.0, 2.0, 0.5, 0.5]), (2, 1, 1))
    return TrackBatch.gaussian(LAYOUT, "map", mean, cov, time_ns=SECOND + k * 100 * MS, track_id=[4, 7])


def driven(own: FusionCentre, delay_ns: int) -> list[Published]:
    """Both sources at 10 Hz; at the end the prompt one goes on until all that is late has come."""
    arrivals = [(SECOND + k * 100 * MS + MS, 0, k) for k in range(PROMPT_STEPS)]
    arrivals += [(SECOND + k * 100 * MS + delay_ns, 1, k) for k in range(STEPS)]
    published, told_ns = [], SECOND
    for now_ns, source, k in [*sorted(arrivals), (SECOND + PROMPT_STEPS * 100 * MS, None, 0)]:
        while (wake_ns := own.wake_ns(told_ns)) is not None and wake_ns < now_ns:
            told_ns = wake_ns
            published += own.advance(wake_ns)
        told_ns = now_ns
        if source is not None:
            assert own.receive(source, scan(source, k), SECOND + k * 100 * MS, now_ns) is None
            published += own.advance(now_ns)
    return published


def unlimited(**buffer) -> FusionCentre:
    return centre(max_rewind_share=1.0, **buffer)


@pytest.mark.parametrize("delay_ns", [30 * MS, DELAY_NS, 1400 * MS])
def test_a_late_source_leaves_the_state_that_a_prompt_one_would(delay_ns):
    late, prompt = unlimited(), unlimited()
    published = driven(late, delay_ns)
    for k in range(PROMPT_STEPS):
        prompt.step(SECOND + k * 100 * MS, {source: scan(source, k) for source in range(1 + (k < STEPS))})
    assert sum(result.rewound.repeated for result in published if result.rewound) >= STEPS
    for own, other in zip(vars(late.tracks).values(), vars(prompt.tracks).values(), strict=False):
        if isinstance(own, np.ndarray):
            np.testing.assert_array_equal(own, other)
    times = [result.time_ns for result in published]
    assert times == sorted(set(times))
    assert {i for result in published for i in result.tracks.track_id.tolist()} == {1, 2}
    assert len({bytes(u) for result in published for u in result.tracks.uuid}) == 2
    assert not any(result.kept_out for result in published)


@pytest.mark.parametrize("rate_hz", [10.0, 7.0])
def test_at_a_fixed_rate_a_late_scan_joins_the_step_that_it_would_have(rate_hz):
    """Ticks are no stamps: of two scans of a source in one tick the newer counts, whenever it came."""
    late, prompt = (unlimited(trigger="rate", output_rate_hz=rate_hz) for _ in range(2))
    published = driven(late, DELAY_NS), driven(prompt, 2 * MS)
    ticks = [{result.time_ns % round(SECOND / rate_hz) for result in results} for results in published]
    assert ticks == [{0}, {0}]
    for name in ("mean", "cov", "time_ns", "track_id"):
        np.testing.assert_array_equal(getattr(late.tracks, name), getattr(prompt.tracks, name))
    kept = [[(step.time_ns, sorted(step.scans)) for step in own.history.kept] for own in (late, prompt)]
    assert kept[0] == kept[1]


def test_a_piece_that_comes_after_its_scan_was_fused_joins_it():
    own = unlimited(assembly_window_s=0.0, gather_window_s=0.0)
    sources = SourceConfig("whole"), SourceConfig("pieces", assembles=True)
    own = FusionCentre(dataclasses.replace(own.config, sources=sources), lambda: 0.0)
    arrivals = [
        (0, scan(0, 0), 0),
        (1, scan(1, 1)[:1], 1),
        (0, scan(0, 2), 2),
        (1, scan(1, 1)[1:], 1),
        (0, scan(0, 3), 3),
    ]
    for k, (source, tracks, stamp) in enumerate(arrivals):
        now_ns = SECOND + 100 * k * MS
        assert own.receive(source, tracks, SECOND + 100 * stamp * MS, now_ns) is None
        list(own.advance(now_ns))
    whole = next(step for step in own.history.kept if step.time_ns == SECOND + 100 * MS)
    assert whole.scans[1].scan.track_id.tolist() == [4, 7]


def test_predicting_the_same_late_scans_gives_another_state():
    """What the law above would miss if rewinding did nothing."""
    retrodicted, predicted = unlimited(), centre(out_of_sequence="predict")
    driven(retrodicted, DELAY_NS)
    driven(predicted, DELAY_NS)
    assert not np.allclose(retrodicted.tracks.mean, predicted.tracks.mean, atol=1e-3)


def test_a_source_always_late_stays_inside_the_share_of_the_time():
    """Each rewind takes 60 ms of every 100: the excess is predicted and counted, nothing is lost silently."""
    clock = itertools.count(0, 0.06)
    own = centre(lambda: next(clock))
    published = driven(own, DELAY_NS)
    repeated = [result for result in published if result.rewound is not None]
    seconds = (published[-1].time_ns - published[0].time_ns) / SECOND
    assert 0.06 * len(repeated) <= 0.3 * seconds + 0.3 * 2.0 + 0.06
    assert 0.06 * len(repeated) > 0.3 * STEPS * 0.1
    assert len(repeated) + sum(result.beyond_share for result in published) == STEPS
    # What was predicted to a step gives way when the scan of that step itself comes.
    assert {reason for result in published for reason in result.kept_out} <= {"superseded_scan"}


def test_late_scans_that_cannot_be_repeated_for_are_kept_out_by_reason():
    own = unlimited(history_length_s=0.2, max_delay_s=5.0)
    published = driven(own, 1400 * MS)
    kept_out = sum((result.kept_out for result in published), published[0].kept_out)
    assert set(kept_out) == {"older_than_history"}
    assert kept_out["older_than_history"] == STEPS


def test_a_reset_goes_on_with_names_that_nobody_had():
    own = unlimited()
    driven(own, DELAY_NS)
    given = own.history.next_id
    own.reset()
    own.step(SECOND, {0: scan(0, 0)})
    assert own.tracks.track_id.tolist() == [given, given + 1]
    assert own.history.kept[0].before.state.time_ns == -1
