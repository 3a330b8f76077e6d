"""A study: some Monte Carlo runs of one scenario, cut into pieces that can be worked on anywhere."""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from track_fusion.params import ParameterError
from track_fusion.plugins import is_path
from track_fusion.rules import find_rule
from track_fusion.study.rows import Outcomes
from track_fusion.study.rule_choice import RuleChoice
from track_fusion.study.scenario import Scenario


@dataclasses.dataclass(frozen=True)
class Study:
    """What is asked of one scenario.

    Attributes
    ----------
    scenario : str                 key, or path of a Python file that defines SCENARIO
    find : callable                scenario -> Scenario, here and in the workers
    runs, seed : int
    only : str                     beginning of the names of the rows wanted
    rules : tuple or None          compare these rules instead of running the scenario's rows
    """

    scenario: str
    find: Callable[[str], Scenario] = dataclasses.field(repr=False)
    runs: int
    seed: int
    only: str = ""
    rules: tuple[RuleSpec, ...] | None = None

    def pieces(self) -> list[range]:
        """Cut the runs; where depends on the scenario alone."""
        size = self.find(self.scenario).piece
        return [range(start, min(start + size, self.runs)) for start in range(0, self.runs, size)]

    def name(self, piece: range) -> str:
        """Name of the file that keeps a piece."""
        what = re.sub(r"[^\w.@-]+", "_", Path(self.scenario).stem if is_path(self.scenario) else self.scenario)
        asked = hashlib.sha256(repr(dataclasses.replace(self, runs=0)).encode())
        for given in (self.scenario, *(spec.rule for spec in self.rules or ())):
            asked.update(Path(given).read_bytes() if is_path(given) else b"")
        return f"{what}-{asked.hexdigest()[:16]}-seed{self.seed}-runs{piece.start}-{piece.stop}.npz"

    def simulate(self, piece: range) -> Outcomes:
        """Simulate the runs of a piece."""
        scenario = self.find(self.scenario)
        if self.rules is None:
            return scenario.simulate(piece, self.seed, _silent, self.only)
        return scenario.compare([choice(scenario, spec) for spec in self.rules], piece, self.seed, _silent)


@dataclasses.dataclass(frozen=True)
class RuleSpec:
    """A rule to compare: key or path of a Python file that defines RULE, its parameters by name, a variant's name."""

    rule: str
    params: tuple[tuple[str, Any], ...] = ()
    variant: str = ""


@dataclasses.dataclass(frozen=True)
class Result:
    """What came of a study: the outcomes of all runs, and the processor time they took in seconds."""

    study: Study
    outcomes: Outcomes
    took_s: float


def choice(scenario: Scenario, spec: RuleSpec) -> RuleChoice:
    """Return a rule with the parameters given; without any, with those that the scenario gives it, else its defaults.

    Raises
    ------
    ParameterError    no such rule, variant or parameter
    """
    rule = find_rule(spec.rule)
    name = f"{rule.key}@{spec.variant}" if spec.variant else rule.key
    ours = {c.name: c for c in scenario.rules}
    if name in ours and not spec.params:
        return ours[name]
    if spec.variant and not spec.params:
        raise ParameterError(f"The scenario '{scenario.key}' has no '{name}'. It has: {', '.join(sorted(ours))}.")
    return RuleChoice.of(rule.key, spec.variant, **dict(spec.params))


def _silent(share: float) -> None:
    pass
