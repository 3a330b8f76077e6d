"""How old results are when they arrive: quantiles from a histogram, whatever their number."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

#: Bins a decade: a quantile is right to half a bin, 1.2 %.
BINS_A_DECADE = 100
#: Shorter latencies than the first of these are told as 0, longer ones than the second as that.
SHORTEST_S, LONGEST_S = 1e-6, 1e4
QUANTILES = {"p50_s": 0.5, "p95_s": 0.95, "p99_s": 0.99}


class Latencies:
    """Counts latencies by size."""

    def __init__(self) -> None:
        self._bins = np.zeros(2 + round(BINS_A_DECADE * math.log10(LONGEST_S / SHORTEST_S)), np.int64)
        self._total_s, self._longest_s = 0.0, -math.inf

    def add(self, latency_s: float) -> None:
        """Take one; it may be negative where clocks differ."""
        decades = math.log10(max(latency_s, SHORTEST_S) / SHORTEST_S)
        at = 0 if latency_s <= SHORTEST_S else 1 + int(BINS_A_DECADE * decades)
        self._bins[min(at, len(self._bins) - 1)] += 1
        self._total_s += latency_s
        self._longest_s = max(self._longest_s, latency_s)

    def figures(self) -> Mapping[str, Any]:
        """Number, mean, quantiles and maximum, ready for JSON; None where there are none."""
        count = int(self._bins.sum())
        if not count:
            return {"samples": 0, "mean_s": None, **dict.fromkeys(QUANTILES), "max_s": None}
        at = np.searchsorted(np.cumsum(self._bins), [math.ceil(q * count) for q in QUANTILES.values()])
        middle_s = SHORTEST_S * 10.0 ** ((at - 0.5) / BINS_A_DECADE)
        told = dict(zip(QUANTILES, np.where(at > 0, np.minimum(middle_s, LONGEST_S), 0.0).tolist(), strict=True))
        return {"samples": count, "mean_s": self._total_s / count, **told, "max_s": self._longest_s}
