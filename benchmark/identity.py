"""Ghosts, identities and GOSPA of the centre with its defaults, beside a single gate without links."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from benchmark import scenes
from benchmark.scenes import Scene
from track_fusion.centre.centre import FusionCentre
from track_fusion.centre.config import CentreConfig, FusionCentreParams, SourceConfig
from track_fusion.linalg import Array
from track_fusion.rules import RULES

#: GOSPA: who is farther than this from a target, in metres, does not track it; errors count squared.
CUT_OFF_M = 6.0
PERIOD_S = 0.1


def single_gate(probability: float) -> dict[str, Any]:
    """Parameters of a centre without memory of who fed what: one gate alone."""
    return {"gate_probability": probability, "keep_probability": probability, "patience": 0, "merge_duplicates": "off"}


@dataclasses.dataclass(frozen=True)
class Score:
    """How a centre did in a scene, step by step (K): what was published and what lived, GOSPA; and over all of it.

    `switches` counts how often a target's track got another identifier, `ids` all that were published.
    """

    published: Array
    living: Array
    gospa: Array
    switches: int
    ids: int

    @property
    def ghosts(self) -> float:
        """Share of steps with more tracks than targets."""
        return float((self.published > self.living).mean())


def centre_of(sources: int = 2, **params: Any) -> FusionCentre:
    """Make a centre of default parameters but these."""
    rule, names = RULES["covariance_intersection"], tuple(SourceConfig(f"sensor_{k}") for k in range(sources))
    return FusionCentre(CentreConfig(names, scenes.MOTION, "map", rule, rule.params(), FusionCentreParams(**params)))


def score(scene: Scene, **params: Any) -> Score:
    """Run a centre through a scene and judge what it publishes."""
    centre, rows = centre_of(len(scene.reports), **params), []
    last: dict[int, int] = {}
    switches, ids = 0, set[int]()
    for time_ns, scans, truth in scene.steps():
        fused, _ = centre.step(time_ns, scans)
        living = np.flatnonzero(np.isfinite(truth[:, 0]))
        of_target, gospa = judged(fused.mean[:, 0, :2], truth[living])
        rows.append((len(fused), len(living), gospa))
        for i, j in of_target.items():
            target, own = int(living[j]), int(fused.track_id[i])
            switches += last.setdefault(target, own) != own
            last[target] = own
        ids.update(fused.track_id.tolist())
    return Score(*np.array(rows).T, switches, len(ids))


def judged(tracks: Array, truth: Array) -> tuple[dict[int, int], float]:
    """Pair tracks with targets, positions (N, 2) and (L, 2): pairs, and GOSPA (p = alpha = 2)."""
    squared = np.minimum(((tracks[:, None] - truth) ** 2).sum(-1), CUT_OFF_M**2)
    row, col = linear_sum_assignment(squared)
    near = squared[row, col] < CUT_OFF_M**2
    alone = len(tracks) + len(truth) - 2 * near.sum()
    pairs = dict(zip(row[near].tolist(), col[near].tolist(), strict=True))
    return pairs, float(np.sqrt(squared[row, col][near].sum() + alone * CUT_OFF_M**2 / 2))
