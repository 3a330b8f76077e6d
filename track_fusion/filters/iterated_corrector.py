"""The iterated corrector (IC): several sensors' measurements of one time, used one after the other."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Generic, TypeVar

from track_fusion.filters.base import Evidence, Filter, Likelihood
from track_fusion.linalg import Array

S = TypeVar("S")
M = TypeVar("M")
H = TypeVar("H")


@dataclasses.dataclass(frozen=True)
class IteratedCorrector(Generic[S, M, H]):
    """A filter that updates by several sensors, whose errors are independent, in turn.

    Notes         For linear sensors it is the exact posterior, whatever the order; for others the order
                  matters: the sharpest sensor first makes the later linearisations better.
    References    Li 2022 (46).
    """

    one: Filter[S, M, Array, H, Likelihood]

    def predict(self, state: S, motion: M) -> S:
        """Predict as the filter does."""
        return self.one.predict(state, motion)

    def update(self, state: S, zs: Sequence[Array], sensors: Sequence[H]) -> tuple[S, Evidence]:
        """Condition on all measurements.

        Parameters
        ----------
        state
        zs : sequence of (..., m_i)
        sensors : sequence of Sensor

        Returns
        -------
        the state, Evidence of all measurements
        """
        parts = []
        for z, sensor in zip(zs, sensors, strict=True):
            state, learned = self.one.update(state, z, sensor)
            parts.append(learned.log_likelihood)
        return state, Evidence(sum(parts[1:], start=parts[0]))
