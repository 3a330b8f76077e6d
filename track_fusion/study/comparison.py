"""What is made of the scores of rules under the same noise: which is better, which diverged, which is consistent."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from track_fusion.linalg import Array
from track_fusion.metrics.accuracy import Estimate
from track_fusion.metrics.certainty import surely_positive
from track_fusion.metrics.significance import Difference, Mask, diverged_runs, paired_differences, robust_mean
from track_fusion.study.rows import Outcomes

#: What smaller scores mean: better; nothing, being what a rule claims itself; or too timid, 1 being right.
Kind = Literal["error", "claimed", "consistency"]


class Group(NamedTuple):
    """Scores that are compared: of one quantity with one filter."""

    filter: str
    quantity: str

    @property
    def kind(self) -> Kind:
        """By the beginning of the quantity's name."""
        kinds: tuple[Kind, ...] = ("claimed", "consistency")
        return next((kind for kind in kinds if self.quantity.startswith(f"{kind}_")), "error")

    @property
    def may_diverge(self) -> bool:
        """Whether it is an error of a track, so that a run can lose the target."""
        return self.kind == "error" and bool({"error", "rmse"} & set(self.quantity.split("_")))


@dataclasses.dataclass(frozen=True)
class Score:
    """What a rule attained in one group.

    Attributes
    ----------
    rule : str
    mean : Estimate            over all runs
    robust_mean : float        without the lowest and the highest tenth of the runs
    diverged : float           share of the runs that lost the target
    distance : float or None   of the mean from 1, of a conservative rule only that above; None: not about consistency
    consistency : str          "overconfident", "underconfident", "conservative" (below 1, as it promises), "consistent"
                               (1 within its error), "undecided" (a single run); "" where distance is None
    """

    rule: str
    mean: Estimate
    robust_mean: float
    diverged: float
    distance: float | None = None
    consistency: str = ""


def grouped(outcomes: Outcomes) -> dict[Group, Outcomes]:
    """Group scores named <filter>-<rule>/<quantity>: {group: {rule: (R,)}}."""
    groups: dict[Group, Outcomes] = {}
    for name, values in outcomes.items():
        row, _, quantity = name.rpartition("/")
        one, _, rule = row.partition("-")
        groups.setdefault(Group(one, quantity), {})[rule] = values
    return groups


def scores(groups: Mapping[Group, Outcomes], conservative: Sequence[str]) -> dict[Group, list[Score]]:
    """Describe every rule in every group; `conservative` are the rules that promise not to claim too little."""
    return {
        group: [_score(group, rule, values, lost[rule], rule in conservative) for rule, values in of_rules.items()]
        for group, of_rules in groups.items()
        for lost in (_diverged(group, of_rules),)
    }


def differences(groups: Mapping[Group, Outcomes]) -> dict[Group, list[Difference]]:
    """Compare the rules in each group in which smaller is better."""
    errors = {group: of_rules for group, of_rules in groups.items() if group.kind == "error"}
    return paired_differences(errors, {group: _diverged(group, of_rules) for group, of_rules in errors.items()})


def _diverged(group: Group, of_rules: Outcomes) -> dict[str, Mask]:
    if group.may_diverge:
        return diverged_runs(of_rules)
    return {rule: ~np.isfinite(values) for rule, values in of_rules.items()}


def _score(group: Group, rule: str, values: Array, lost: Mask, is_conservative: bool) -> Score:
    mean = Estimate.mean(values)
    score = Score(rule, mean, robust_mean(values), float(lost.mean()))
    if group.kind != "consistency":
        return score
    excess = mean.value - 1.0
    distance = max(excess, 0.0) if is_conservative else abs(excess)
    return dataclasses.replace(score, distance=distance, consistency=_consistency(values - 1.0, is_conservative))


def _consistency(excess: Array, is_conservative: bool) -> str:
    if len(excess) < 2:
        return "undecided"
    if surely_positive(excess):
        return "overconfident"
    if surely_positive(-excess):
        return "conservative" if is_conservative else "underconfident"
    return "consistent"
