"""Tracks against the truth: errors and consistency, per target and over all, in a memory that does not grow."""

from __future__ import annotations

import copy
import dataclasses
from typing import Any, NamedTuple

from track_fusion.metrics.consistency import Consistency, consistency_of_sum
from track_fusion.metrics.gospa import SetDistanceParams
from track_fusion.metrics.latency import Latencies
from track_fusion.metrics.pairing import Pairs, paired
from track_fusion.metrics.scores import Scores
from track_fusion.metrics.tally import Errors, Tally, TargetTallies
from track_fusion.metrics.truth import Known, Truth
from track_fusion.params import Params, param
from track_fusion.solvers.chi_square import chi_square_quantile
from track_fusion.tracks import SECOND_NS, StateLayout, TrackBatch

#: Fewer samples than this prove nothing.
MIN_SAMPLES = 10
#: How often a consistent estimator may be called overconfident: seldom, since one looks again and again while samples
#: come, and samples of one run are correlated.
FALSE_ALARM = 1e-5
#: With a larger share of samples that could not be judged nothing is called consistent.
MAX_UNJUDGED = 0.05
#: So many scans wait for the truth at most, and so many steps of the truth for scans.
MAX_HELD = 1000


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
    max_gap_s: float = param(
        1.0,
        "tracks are judged between two states of the truth, too, when these are no farther apart; 0: at equal stamps "
        "only",
        unit="s",
        low=0.0,
    )


class Judgement(NamedTuple):
    """One scan against the truth: pairs, tracks in the scan, and the truth; None: there is none of that time."""

    pairs: Pairs | None
    tracks: TrackBatch
    truth: Known | None


class Totals:
    """Sums over judged scans."""

    def __init__(self, layout: StateLayout, scored: SetDistanceParams) -> None:
        self._layout, self.all, self.targets = layout, Tally(layout), TargetTallies(layout)
        self.scores = Scores(scored)
        self.times = self.missed = self.false = self.unjudged = self.unjudged_times = 0

    def add(self, judged: Judgement) -> None:
        """Take a scan."""
        pairs, tracks, truth = judged
        if pairs is None or truth is None:
            self.unjudged_times += 1
            self.unjudged += max(len(tracks), 1)  # nobody knows how many targets there were
            return
        matched = len(pairs.nees)
        self.times += 1
        self.missed += len(truth.targets) - matched
        self.unjudged += truth.unknown
        # A track without a target may be that of one whose truth is unknown.
        self.false += max(len(tracks) - matched - truth.unknown, 0)
        if not truth.unknown:  # else nobody knows which tracks are false
            at = list(self._layout.position)
            self.scores.add(truth.targets, truth.states[:, at], tracks.track_id, tracks.moments[0][:, at])
        errors = Errors.of(self._layout, pairs.error, pairs.nees)
        self.all.add(errors)
        for k, (i, j) in enumerate(zip(pairs.target, pairs.track, strict=True)):
            self.targets.add(int(truth.targets[i]), int(tracks.track_id[j]), errors.one(k))

    @property
    def is_incomplete(self) -> bool:
        """Whether more samples could not be judged than may be passed over."""
        return _is_incomplete(self.all.samples + self.missed, self.unjudged)


class Evaluation:
    """Judges tracks where the truth is known: at its stamps, and between them by interpolation.

    Truth and tracks come in any order. A scan is judged as soon as the truth around it is there, and anew when more of
    that truth comes, until the truth has gone on by `max_gap_s`; from then on it is part of sums. Targets and tracks
    are matched one to one by least total distance between positions. Neither the truth nor the tracks are
    extrapolated: what is not covered is counted as unjudged.

    Parameters
    ----------
    layout : StateLayout
    params : EvaluationParams
    whole_truth : bool    each step of the truth is one table; False: it comes target by target, and may have gaps
    scored : SetDistanceParams    of GOSPA and the other scores; None: the defaults
    """

    def __init__(
        self, layout: StateLayout, params: EvaluationParams, whole_truth: bool = True,
        scored: SetDistanceParams | None = None,
    ) -> None:  # fmt: skip
        self._layout, self._params = layout, params
        self._latencies = Latencies()
        self._max_gap_ns = round(params.max_gap_s * SECOND_NS)
        self._truth = Truth(layout, self._max_gap_ns, whole_truth)
        self._scans: dict[int, TrackBatch] = {}  # not yet in the sums
        self._judged: dict[int, Judgement] = {}  # of these, as far as they can be judged so far
        self._closed = Totals(layout, scored or SetDistanceParams())
        self._closed_ns: int | None = None  # stamp of the last scan in the sums
        self._answered: set[int] = set()  # steps of the truth held that a scan was judged at
        self._unanswered = 0  # steps of the truth dropped that none was

    @property
    def times(self) -> int:
        """Number of times judged."""
        return self._closed.times + len(self._judged)

    @property
    def unjudged(self) -> int:
        """Number of samples that could not be judged; the truth of the newest may still be on its way."""
        late = max(self._scans, default=0) - self._max_gap_ns
        waiting = [tracks for s, tracks in self._scans.items() if s < late and s not in self._judged]
        return self._closed.unjudged + sum(max(len(tracks), 1) for tracks in waiting)

    @property
    def is_incomplete(self) -> bool:
        """Whether these are too many for a verdict."""
        return _is_incomplete(self.consistency().samples + self._closed.missed, self.unjudged)

    def add_truth(self, truth: TrackBatch, stamp_ns: int | None = None) -> None:
        """Take the true states at a time, or of some targets; a repeated one replaces the one before.

        `stamp_ns` tells the time of a step without targets, which has none of its own.
        """
        if stamp_ns is None:
            if not len(truth):
                return
            stamp_ns = int(truth.time_ns[0])
        self._truth.add(stamp_ns, truth.track_id.tolist(), truth.moments[0])
        for scan_ns in [s for s in self._scans if abs(s - stamp_ns) <= self._max_gap_ns]:
            judged = self._judged.get(scan_ns)
            if scan_ns == stamp_ns or judged is None or judged.truth is None or not judged.truth.exact:
                self._judge(scan_ns)
        self._settle()

    def add_tracks(self, stamp_ns: int, tracks: TrackBatch, arrival_ns: int | None = None) -> None:
        """Take the tracks of a time, also when there are none; `arrival_ns`, if known, tells how late they came."""
        if arrival_ns is not None:
            self._latencies.add((arrival_ns - stamp_ns) / SECOND_NS)
        tracks = tracks[tracks.is_confirmed] if self._params.confirmed_only else tracks
        if self._closed_ns is not None and stamp_ns <= self._closed_ns:
            self._closed.add(Judgement(None, tracks, None))
            return
        self._scans[stamp_ns] = tracks
        self._judge(stamp_ns)
        self._settle()

    def _judge(self, stamp_ns: int) -> None:
        """Judge a scan as far as it can be."""
        judged = self._judgement(stamp_ns)
        if judged.truth is not None:
            self._judged[stamp_ns] = judged

    def _judgement(self, stamp_ns: int) -> Judgement:
        tracks, known = self._scans[stamp_ns], self._truth.at(stamp_ns)
        if known is None:
            return Judgement(None, tracks, None)
        return Judgement(
            paired(self._layout, known.states, *tracks.moments, self._params.max_distance_m), tracks, known
        )

    def _settle(self) -> None:
        """Close the scans that no more truth will change, and drop the truth that no scan needs any more."""
        newest, ordered = self._truth.newest_ns, sorted(self._scans)
        last = ordered[-1] if ordered else self._closed_ns
        for k, stamp_ns in enumerate(ordered):
            if (newest is None or stamp_ns >= newest - self._max_gap_ns) and len(ordered) - k <= MAX_HELD:
                break
            self._close(stamp_ns)
        first = min(self._scans, default=last)
        if first is None:
            first = self._truth.stamps[0]
        for stamp_ns in self._truth.forget(first - self._max_gap_ns, MAX_HELD):
            self._unanswered += stamp_ns not in self._answered
            self._answered.discard(stamp_ns)

    def _close(self, stamp_ns: int) -> None:
        judged = self._judged.get(stamp_ns)
        if judged is None or judged.truth is None or not judged.truth.exact:
            judged = self._judgement(stamp_ns)
        self._closed.add(judged)
        if judged.truth is not None and self._truth.has(stamp_ns):
            self._answered.add(stamp_ns)
        del self._scans[stamp_ns]
        self._judged.pop(stamp_ns, None)
        self._closed_ns = stamp_ns

    def consistency(self) -> Consistency:
        """ANEES over all targets and times; kept up to date, since a node asks at every message."""
        scores = [judged.pairs.nees for judged in self._judged.values() if judged.pairs is not None]
        total = self._closed.all.nees + sum(float(nees.sum()) for nees in scores)
        return consistency_of_sum(total, self._closed.all.samples + sum(map(len, scores)), self._layout.size)

    def is_overconfident(self) -> bool:
        """Tell whether errors are larger than the covariances say, on enough samples and beyond doubt."""
        score = self.consistency()
        terms = score.samples * score.axes
        return score.samples >= MIN_SAMPLES and score.anees > chi_square_quantile(1.0 - FALSE_ALARM, terms) / terms

    def result(self) -> dict[str, Any]:
        """Everything as JSON-ready values: figures over all and for each target, what was unmatched or not judged.

        Of the scores, times at which some truth is unknown are left out.

        The verdict over all is "incomplete" instead of "consistent" when too many samples could not be judged.
        """
        totals = copy.deepcopy(self._closed)
        for stamp_ns in sorted(self._scans):
            totals.add(self._judgement(stamp_ns))
        figures = totals.all.figures()
        if totals.is_incomplete and figures["verdict"] == "consistent":
            figures["verdict"] = "incomplete"
        lonely = sum(s not in self._answered and s not in self._scans for s in self._truth.stamps)
        return {
            "times": totals.times,
            "unmatched_times": self._unanswered + lonely + totals.unjudged_times,
            "unjudged_times": totals.unjudged_times,
            "missed": totals.missed,
            "false": totals.false,
            "unjudged": totals.unjudged,
            "all": figures,
            "scores": totals.scores.figures(),
            "latency": self._latencies.figures(),
            "targets": totals.targets.figures(),
        }


def _is_incomplete(judged: int, unjudged: int) -> bool:
    return unjudged > MAX_UNJUDGED * (judged + unjudged)
