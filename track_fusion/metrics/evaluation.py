"""Tracks against the truth: errors and consistency, per target and over all."""

from __future__ import annotations

import dataclasses
import math
from collections import defaultdict
from typing import Any, NamedTuple

import numpy as np

from track_fusion.linalg import Array
from track_fusion.metrics.consistency import Consistency, consistency, consistency_of_sum
from track_fusion.metrics.pairing import paired
from track_fusion.params import Params, param
from track_fusion.solvers.chi_square import chi_square_quantile
from track_fusion.tracks import StateLayout, TrackBatch

#: Fewer samples than this prove nothing.
MIN_SAMPLES = 10
#: How often a consistent estimator may be called overconfident: seldom, since one looks again and again while samples
#: come, and samples of one run are correlated.
FALSE_ALARM = 1e-5


@dataclasses.dataclass(frozen=True)
class EvaluationParams(Params):
    """How tracks are matched with the truth."""

    max_distance_m: float = param(
        1000.0,
        "a track farther from every target than this is false, a target without a nearer track missed",
        unit="m",
        low=0.0,
        strict=True,
    )
    confirmed_only: bool = param(True, "judge confirmed tracks only")


class Sample(NamedTuple):
    """A target with its track at one time: identifiers, error (n,), NEES."""

    target: int
    track: int
    error: Array
    nees: float


class Evaluation:
    """Collects truth and tracks by stamp, in any order, and judges each time at which both are there.

    Targets and tracks are matched one to one by least total distance between positions.
    """

    def __init__(self, layout: StateLayout, params: EvaluationParams) -> None:
        self._layout, self._params = layout, params
        self._truth: dict[int, list[TrackBatch]] = defaultdict(list)
        self._tracks: dict[int, TrackBatch] = {}
        self._judged: dict[int, list[Sample]] = {}
        self._nees_sum, self._samples_judged = 0.0, 0

    @property
    def times(self) -> int:
        """Number of times judged."""
        return len(self._judged)

    def add_truth(self, truth: TrackBatch) -> None:
        """Take the true state of a target; a repeated one replaces the one before."""
        if len(truth):
            stamp_ns, again = int(truth.time_ns[0]), set(truth.track_id.tolist())
            others = [b for b in self._truth[stamp_ns] if again.isdisjoint(b.track_id.tolist())]
            self._truth[stamp_ns] = [*others, truth]
            self._judge(stamp_ns)

    def add_tracks(self, stamp_ns: int, tracks: TrackBatch) -> None:
        """Take the tracks of a time, also when there are none."""
        self._tracks[stamp_ns] = tracks[tracks.is_confirmed] if self._params.confirmed_only else tracks
        self._judge(stamp_ns)

    def _judge(self, stamp_ns: int) -> None:
        """Judge one time as soon as truth and tracks are there; more truth of the same time judges it again."""
        if stamp_ns not in self._tracks or stamp_ns not in self._truth:
            return
        truth, tracks = TrackBatch.concatenate(self._truth[stamp_ns]), self._tracks[stamp_ns]
        pairs = paired(self._layout, truth.moments[0], *tracks.moments, self._params.max_distance_m)
        before = self._judged.get(stamp_ns, [])
        self._judged[stamp_ns] = [
            Sample(int(truth.track_id[i]), int(tracks.track_id[j]), error, float(score))
            for i, j, error, score in zip(*pairs, strict=True)
        ]
        self._nees_sum += float(pairs.nees.sum()) - sum(sample.nees for sample in before)
        self._samples_judged += len(pairs.nees) - len(before)

    def consistency(self) -> Consistency:
        """ANEES over all targets and times; kept up to date, since a node asks at every message."""
        return consistency_of_sum(self._nees_sum, self._samples_judged, self._layout.size)

    def is_overconfident(self) -> bool:
        """Tell whether errors are larger than the covariances say, on enough samples and beyond doubt."""
        score = self.consistency()
        terms = score.samples * score.axes
        return score.samples >= MIN_SAMPLES and score.anees > chi_square_quantile(1.0 - FALSE_ALARM, terms) / terms

    def result(self) -> dict[str, Any]:
        """Everything as JSON-ready values: figures over all and for each target, unmatched tracks and targets."""
        samples = [sample for _, at_once in sorted(self._judged.items()) for sample in at_once]
        targets = sorted({s.target for s in samples})
        matched = len(samples)
        truths = sum(len(b) for t in self._judged for b in self._truth[t])
        published = sum(len(self._tracks[t]) for t in self._judged)
        return {
            "times": self.times,
            "unmatched_times": len(set(self._truth) ^ set(self._tracks)),
            "missed": truths - matched,
            "false": published - matched,
            "all": self._figures(samples),
            "targets": {
                str(t): self._figures([s for s in samples if s.target == t])
                | {"track_ids": sorted({s.track for s in samples if s.target == t})}
                for t in targets
            },
        }

    def _figures(self, samples: list[Sample]) -> dict[str, Any]:
        """RMSE, mean error norm (the one-run ARMSE) and consistency of some samples."""
        errors = np.array([s.error for s in samples]).reshape(-1, self._layout.size)
        score = consistency(np.array([s.nees for s in samples]), self._layout.size)
        figures: dict[str, Any] = {"samples": len(samples)}
        rate = tuple(i for i, name in enumerate(self._layout.axes) if name == "turn_rate")
        quantities = [("position", self._layout.position, "m", 1.0), ("velocity", self._layout.velocity, "mps", 1.0)]
        quantities += [("turn_rate", rate, "degps", float(np.degrees(1.0)))] if rate else []
        for name, at, unit, factor in quantities:
            norm = factor * np.linalg.norm(errors[:, list(at)], axis=1)
            figures[f"{name}_rmse_{unit}"] = _number(np.sqrt((norm**2).mean()) if len(norm) else math.nan)
            figures[f"{name}_armse_{unit}"] = _number(norm.mean() if len(norm) else math.nan)
        figures |= {
            "anees": _number(score.anees), "anees_low": _number(score.low), "anees_high": _number(score.high),
            "verdict": score.verdict,
        }  # fmt: skip
        return figures


def _number(value: float) -> float | None:
    """JSON knows no NaN."""
    return None if math.isnan(value) else float(value)
