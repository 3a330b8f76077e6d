"""Rules as a study chooses them, and fusion by them over Monte Carlo runs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np

from track_fusion.angles import wraps
from track_fusion.linalg import Array, matvec, transpose
from track_fusion.params import ParameterError, Params, from_dict
from track_fusion.rules import RULES, FusedTracks, Rule, SourceTracks
from track_fusion.study.rows import Outcomes, Progress, row_by_row


@dataclasses.dataclass(frozen=True)
class RuleChoice:
    """A rule with the parameters that a scenario gives it, and the name of the variant ("" = the paper's)."""

    key: str
    params: Params
    variant: str = ""

    @classmethod
    def of(cls, key: str, variant: str = "", /, **values: Any) -> RuleChoice:
        """Choose a rule by its key; parameters that are not given have their defaults.

        Raises
        ------
        ParameterError    no such rule or parameter
        """
        return cls(key, from_dict(RULES[key].params, values), variant)

    @property
    def name(self) -> str:
        """`key` or `key@variant`."""
        return f"{self.key}@{self.variant}" if self.variant else self.key

    @property
    def rule(self) -> Rule:
        """The rule itself."""
        return RULES[self.key]

    @property
    def random(self) -> bool:
        """Whether the rule samples, so that each run has a result of its own."""
        return self.rule.uses("seed", self.params)

    def fuse(self, tracks: SourceTracks) -> FusedTracks:
        """Fuse tracks that are known to be sound."""
        return self.rule.apply(tracks, self.params)


def fuse_runs(
    choice: RuleChoice,
    mean: Array,
    cov: Array,
    rngs: Sequence[np.random.Generator] | None = None,
    dof: float = math.inf,
    periods: Sequence[float] = (),
) -> FusedTracks:
    """Fuse the tracks of R runs, covariances that all runs share only once.

    Parameters
    ----------
    mean : (R, K, n)
    cov : (R, K, n, n), or (1, K, n, n) where all runs have the same
    rngs : one generator a run, or None    for a rule that samples: each run then draws its own numbers
    dof : float    degrees of freedom of every track
    periods : (n,)    of axes that wrap; empty: none does

    Returns
    -------
    FusedTracks    mean (R, n), cov (R, n, n) or (1, n, n), weights (R, K), (1, K) or None

    Notes    A linear rule gives sum of A_i x_i; fusing unit vectors gives its matrices A_i.
    """
    runs, count, n = mean.shape
    if len(cov) < runs and choice.rule.linear and not wraps(periods):
        units = np.eye(count * n).reshape(-1, count, n)
        fused = choice.fuse(SourceTracks(units, np.repeat(cov, len(units), 0)))
        weights = None if fused.weights is None else fused.weights[:1]
        return FusedTracks(matvec(transpose(fused.mean), mean.reshape(runs, -1)), fused.cov[:1], weights)
    dofs = np.full((runs, count), dof) if math.isfinite(dof) else None
    tracks = SourceTracks(mean, np.broadcast_to(cov, (runs, count, n, n)), dofs, periods=periods)
    if rngs is None or not choice.random:
        return choice.fuse(tracks)
    each = [choice.fuse(_one_run(tracks, r, rng)) for r, rng in enumerate(rngs)]
    weighed = [f.weights for f in each if f.weights is not None]
    weights = np.concatenate(weighed) if weighed else None
    return FusedTracks(np.concatenate([f.mean for f in each]), np.concatenate([f.cov for f in each]), weights)


def _one_run(tracks: SourceTracks, run: int, rng: np.random.Generator) -> SourceTracks:
    at = slice(run, run + 1)
    dof = None if tracks.dof is None else tracks.dof[at]
    return SourceTracks(tracks.mean[at], tracks.cov[at], dof, extras={"seed": rng}, periods=tracks.periods)


def check_needs(choices: Sequence[RuleChoice], given: Collection[str] = ()) -> None:
    """Check that rules can do with the tracks and the extras that a scenario gives.

    Raises
    ------
    ParameterError    a rule needs something else
    """
    for choice in choices:
        missing = [name for name in choice.rule.needed(choice.params) if name not in given]
        if missing:
            raise ParameterError(
                f"The 'rules' parameter must be rules for which this scenario has all they need. Got {choice.name!r}, "
                f"which needs {missing[0]!r} beside the tracks."
            )


def rule_by_rule(
    name: str, rules: Sequence[RuleChoice], progress: Progress, measure: Callable[[RuleChoice], Mapping[str, Array]]
) -> Outcomes:
    """Measure any rules one after the other: what many scenarios' `scores` are.

    Parameters
    ----------
    name : str            of the filter, the beginning of the figures' names
    measure : callable    rule -> {quantity and unit: (R,)}
    """
    return row_by_row({f"{name}-{choice.name}": choice for choice in rules}, progress, measure)
