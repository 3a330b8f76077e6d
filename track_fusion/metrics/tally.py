"""Running sums of errors: what a figure needs, whatever the number of samples."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from track_fusion.linalg import Array
from track_fusion.metrics.consistency import Consistency, consistency_of_sum
from track_fusion.solvers.chi_square import chi_square_quantile
from track_fusion.tracks import StateLayout

#: The NEES is counted in so many bins that a consistent estimator fills alike.
BINS = 10
#: So many targets are told one by one; those not seen for the longest are told together.
MAX_TARGETS = 1000
#: So many identifiers of tracks of one target are told.
MAX_TRACK_IDS = 100


class Quantity(NamedTuple):
    """A norm of some axes of the error, in a unit of which one of ours is `factor`."""

    name: str
    axes: tuple[int, ...]
    unit: str
    factor: float = 1.0


def quantities_of(layout: StateLayout) -> tuple[Quantity, ...]:
    """List what is told of the errors of a layout."""
    told = [Quantity("position", layout.position, "m"), Quantity("velocity", layout.velocity, "mps")]
    if "turn_rate" in layout.axes:
        told.append(Quantity("turn_rate", layout.indices(["turn_rate"]), "degps", float(np.degrees(1.0))))
    return tuple(told)


class Errors(NamedTuple):
    """P samples: norms of the Q quantities (P, Q), NEES (P,), its bin (P,)."""

    norms: Array
    nees: Array
    bin: NDArray[np.intp]

    @classmethod
    def of(cls, layout: StateLayout, error: Array, nees: Array) -> Errors:
        """Take them from errors (P, n) and their NEES (P,)."""
        norms = [q.factor * np.linalg.norm(error[:, list(q.axes)], axis=1) for q in quantities_of(layout)]
        return cls(np.stack(norms, -1), nees, np.searchsorted(_deciles(layout.size), nees))

    def one(self, k: int) -> Errors:
        """The k-th sample alone."""
        return Errors(self.norms[k : k + 1], self.nees[k : k + 1], self.bin[k : k + 1])


@functools.cache
def _deciles(axes: int) -> tuple[float, ...]:
    return tuple(chi_square_quantile(k / BINS, axes) for k in range(1, BINS))


class Tally:
    """Sums over samples of errors in a layout."""

    def __init__(self, layout: StateLayout) -> None:
        self._layout = layout
        self.samples, self.nees = 0, 0.0
        self._norms, self._squares = np.zeros((2, len(quantities_of(layout))))
        self._histogram = np.zeros(BINS, np.int64)

    def add(self, errors: Errors) -> None:
        """Take samples."""
        self.samples += len(errors.nees)
        self.nees += float(errors.nees.sum())
        self._norms += errors.norms.sum(0)
        self._squares += (errors.norms**2).sum(0)
        self._histogram += np.bincount(errors.bin, minlength=BINS)

    def merge(self, other: Tally) -> None:
        """Take the samples of another."""
        self.samples += other.samples
        self.nees += other.nees
        self._norms += other._norms
        self._squares += other._squares
        self._histogram += other._histogram

    @property
    def consistency(self) -> Consistency:
        """ANEES with its bounds."""
        return consistency_of_sum(self.nees, self.samples, self._layout.size)

    def figures(self) -> dict[str, Any]:
        """RMSE, mean error norm (the one-run ARMSE) and consistency, ready for JSON."""
        figures: dict[str, Any] = {"samples": self.samples}
        for k, quantity in enumerate(quantities_of(self._layout)):
            mean, square = (self._mean(sums[k]) for sums in (self._norms, self._squares))
            figures[f"{quantity.name}_rmse_{quantity.unit}"] = _number(math.sqrt(square))
            figures[f"{quantity.name}_armse_{quantity.unit}"] = _number(mean)
        score = self.consistency
        figures |= {
            "anees": _number(score.anees), "anees_low": _number(score.low), "anees_high": _number(score.high),
            "verdict": score.verdict, "nees_deciles": self._histogram.tolist(),
        }  # fmt: skip
        return figures

    def _mean(self, total: float) -> float:
        return float(total) / self.samples if self.samples else math.nan


@dataclasses.dataclass
class TargetTally:
    """The sums of one target, with the tracks that were taken for it.

    Attributes
    ----------
    track_ids : dict     the first MAX_TRACK_IDS of them
    id_changes : int     how often it was another track than the time before
    """

    sums: Tally
    track_ids: dict[int, None] = dataclasses.field(default_factory=dict)
    id_changes: int = 0
    _last: int | None = None

    def add(self, errors: Errors, track: int) -> None:
        """Take one sample."""
        self.sums.add(errors)
        if len(self.track_ids) < MAX_TRACK_IDS:
            self.track_ids[track] = None
        self.id_changes += self._last not in (None, track)
        self._last = track

    def figures(self) -> dict[str, Any]:
        """Its figures, ready for JSON."""
        return self.sums.figures() | {"track_ids": sorted(self.track_ids), "id_changes": self.id_changes}


class TargetTallies:
    """The sums of each target; of many, those not seen for the longest are joined."""

    def __init__(self, layout: StateLayout) -> None:
        self._layout = layout
        self._targets: dict[int, TargetTally] = {}  # the last seen is the last
        self._others, self._joined = Tally(layout), 0

    def add(self, target: int, track: int, errors: Errors) -> None:
        """Take one sample of a target."""
        tally = self._targets.pop(target, None) or TargetTally(Tally(self._layout))
        self._targets[target] = tally
        tally.add(errors, track)
        if len(self._targets) > MAX_TARGETS:
            self._others.merge(self._targets.pop(next(iter(self._targets))).sums)
            self._joined += 1

    def figures(self) -> Mapping[str, Any]:
        """The figures by target, and under "others" those of targets that were joined."""
        told: dict[str, Any] = {str(target): self._targets[target].figures() for target in sorted(self._targets)}
        return told | ({"others": self._others.figures() | {"targets": self._joined}} if self._joined else {})


def _number(value: float) -> float | None:
    """JSON knows no NaN."""
    return None if math.isnan(value) else float(value)
