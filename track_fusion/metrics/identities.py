"""Do tracks keep to their targets? Identity switches, MOTA, MOTP, IDF1 and HOTA, as running sums."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from track_fusion.association.assignment import assign, pairs_within
from track_fusion.association.gate import Candidates, Indices
from track_fusion.linalg import Array
from track_fusion.metrics.pair_table import PairTable

#: Similarities from which on HOTA takes a pair for one.
ALPHAS = np.arange(1, 20) / 20.0


class Scene(NamedTuple):
    """Targets and tracks of one time: identifiers (N,), (M,), each once, and the distances between them (N, M), m."""

    targets: NDArray[np.int64]
    tracks: NDArray[np.int64]
    distance: Array


class Identities:
    """Sums over scenes in the order of time.

    A target and a track nearer than the cut-off c may be a pair; their similarity is 1 - distance / c.

    * CLEAR: pairs of the time before stay while they may; the others are made by least distance. A switch is a target
      whose track is another than the last it had.
    * IDF1: each target gets one track for all times, so that most of the times at which both may be a pair are theirs.
    * HOTA: at each time the pairs of most similarity, weighted by how well the two go together over all times. As a
      running sum it knows the times so far only; `identities_of` knows them all, as HOTA is defined.

    Parameters
    ----------
    cutoff_m : float
    known : Identities or None    all that goes together, from a first pass; None: what was seen so far
    bounded : bool                old targets and tracks are settled, so that memory does not grow

    References
    ----------
    K. Bernardin, R. Stiefelhagen, Evaluating multiple object tracking performance: the CLEAR MOT metrics, 2008
    E. Ristani, F. Solera, R. Zou, R. Cucchiara, C. Tomasi, Performance measures and a data set for multi-target,
    multi-camera tracking, 2016
    J. Luiten et al., HOTA: a higher order metric for evaluating multi-object tracking, 2021, equations 14 to 22
    """

    def __init__(self, cutoff_m: float, known: Identities | None = None, bounded: bool = True) -> None:
        self._cutoff_m, self._known, self._bounded = cutoff_m, known, bounded
        self._table = PairTable(len(ALPHAS))
        self._before: dict[int, int] = {}  # pairs of the time before
        self._last: dict[int, int] = {}  # of each target, the last track it had
        self.targets = self.tracks = self.pairs = self.switches = 0
        self._distance = 0.0
        self._alike = np.zeros(len(ALPHAS), np.int64)  # pairs of HOTA

    def add(self, scene: Scene) -> None:
        """Take the scene of a time."""
        self.targets += len(scene.targets)
        self.tracks += len(scene.tracks)
        self._add_clear(scene)
        similarity = np.maximum(1.0 - scene.distance / self._cutoff_m, 0.0)
        row, col = np.nonzero(similarity)
        at = self._table.seen(scene.targets, scene.tracks, row, col)
        total = similarity.sum(0)[None] + similarity.sum(1)[:, None] - similarity
        self._table.together[at] += similarity[row, col] / total[row, col]
        self._table.near[at] += 1
        self._add_hota(scene, similarity, row, col, at)
        for target in self._table.settle() if self._bounded else ():
            self._last.pop(target, None)

    def _add_clear(self, scene: Scene) -> None:
        """Pair anew, keeping to the pairs of the time before."""
        column = {track: j for j, track in enumerate(scene.tracks.tolist())}
        left = scene.distance.copy()
        kept = []
        for i, target in enumerate(scene.targets.tolist()):
            j = column.get(self._before.get(target, -1), -1)
            if j >= 0 and scene.distance[i, j] < self._cutoff_m:
                kept.append((i, j))
                left[i], left[:, j] = np.inf, np.inf
        made = zip(*pairs_within(left, self._cutoff_m), strict=True)
        self._before = {}
        for i, j in [*kept, *made]:
            target, track = int(scene.targets[i]), int(scene.tracks[j])
            self.switches += self._last.get(target, track) != track
            self._before[target] = self._last[target] = track
            self._distance += float(scene.distance[i, j])
        self.pairs += len(self._before)

    def _add_hota(self, scene: Scene, similarity: Array, row: Indices, col: Indices, at: Indices) -> None:
        """Pair by similarity times what goes together, and count the pairs that are alike enough at each alpha."""
        known = self._table if self._known is None else self._known._table
        of_known = at if self._known is None else known.rows(scene.targets, scene.tracks, row, col)
        score = np.zeros_like(similarity)
        score[row, col] = known.alignment(of_known) * similarity[row, col]
        i, j = pairs_within(1.0 - score, 1.0)
        place = np.full(similarity.shape, -1, np.intp)
        place[row, col] = at
        alike = similarity[i, j][:, None] >= ALPHAS - np.finfo(float).eps
        self._table.matched[place[i, j]] += alike
        self._alike += alike.sum(0)

    def figures(self) -> Mapping[str, Any]:
        """The measures, ready for JSON; None where nothing was there to measure."""
        hota, deta, assa = self._hota()
        return {
            "completeness": _ratio(self.pairs, self.targets),
            "id_switches": self.switches,
            "mota": _ratio(2 * self.pairs - self.tracks - self.switches, self.targets),
            "motp_m": _ratio(self._distance, self.pairs),
            "idf1": _ratio(2 * self._identified(), self.targets + self.tracks),
            "hota": hota,
            "deta": deta,
            "assa": assa,
            "settled_targets": self._table.settled_targets,
        }

    def _identified(self) -> int:
        """Times at which targets were near the track that is theirs for all times (IDTP)."""
        target, track, near = self._table.nearby()
        pairs = Candidates(target, track, -near, np.zeros(len(near)))
        rows, cols = (int(x.max(initial=-1)) + 1 for x in (target, track))
        chosen = assign(pairs, rows, cols, 0.0)
        return int(near[chosen[target] == track].sum()) + self._table.settled_near

    def _hota(self) -> tuple[float | None, float | None, float | None]:
        """HOTA, DetA and AssA, averages over alpha."""
        if not self.targets + self.tracks:
            return None, None, None
        detection = self._alike / np.maximum(self.targets + self.tracks - self._alike, 1)
        association = self._table.association() / np.maximum(self._alike, 1)
        return float(np.sqrt(detection * association).mean()), float(detection.mean()), float(association.mean())


def identities_of(scenes: Iterable[Scene], cutoff_m: float) -> Identities:
    """Judge scenes that are all at hand, in the order of time: HOTA then is as it is defined, in two passes."""
    scenes = list(scenes)
    first = Identities(cutoff_m, bounded=False)
    for scene in scenes:
        first.add(scene)
    second = Identities(cutoff_m, known=first, bounded=False)
    for scene in scenes:
        second.add(scene)
    return second


def _ratio(numerator: float, denominator: float) -> float | None:
    return numerator / denominator if denominator else None
