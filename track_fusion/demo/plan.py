"""What a demonstration is to run, and what its parameter file and scenario say of that."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from pathlib import Path

from track_fusion.demo.wiring import Bringup, bringups
from track_fusion.params import Fault, unknown_name_error
from track_fusion.rules import get_rule
from track_fusion.scenarios import SCENARIOS, get_scenario
from track_fusion.study.scenario import Scenario
from track_fusion.study.scene import Scene

#: How a scenario's rows name what the tracker nodes run.
ROWS = {
    "kalman": "kf", "extended": "ekf", "unscented": "ukf", "cubature": "ckf", "particle": "sir", "student_t": "stf",
    "pda": "pda",
}  # fmt: skip
#: Rules that a scenario which has them all is shown with; the last is recorded and drawn.
RULES = ("naive", "covariance_intersection", "arithmetic_average")
#: Library runs to compare with where they cost little.
FAST_RUNS = 1000


@dataclasses.dataclass(frozen=True)
class Demo:
    """What a demonstration runs.

    Attributes
    ----------
    name : str                   of the parameter file
    scenario : Scenario          the one of that file
    row : str                    beginning of its rows, as the scenario names the trackers' filter: kf
    rules : tuple of str         fusion rules, `key` or `key@variant`, besides the unfused first sensor; the last is
                                 recorded and drawn
    out : Path                   results; an earlier result there is replaced
    seed : int                   of the random streams, run 0
    library_runs : int           Monte Carlo runs of the library for comparison
    """

    name: str
    scenario: Scenario
    row: str
    rules: tuple[str, ...]
    out: Path
    seed: int = 0
    library_runs: int = 1000

    @cached_property
    def scene(self) -> Scene:
        """What the nodes run."""
        return self.scenario.played()

    @cached_property
    def bringup(self) -> Bringup:
        """What the parameter file says."""
        return Bringup(self.name)

    @property
    def results(self) -> int:
        """Number of fusions."""
        return self.scene.steps // self.bringup.result_every

    @property
    def many_targets(self) -> bool:
        """Whether the scenario itself judges what the centre publishes."""
        return self.scenario.judge is not None


def demo_of(name: str, out: Path, seed: int, library_runs: int | None, rules: tuple[str, ...] = ()) -> Demo:
    """Make the demonstration of a scenario; its rules are RULES, or the scenario's own, unless given.

    Parameters
    ----------
    name : str                    of a parameter file: a scenario's key, or key and filter
    library_runs : int or None    None: 1000 where the trackers are Kalman filters, which cost little, else what the
                                  scenario does by default

    Raises
    ------
    ParameterError    no such parameter file, or no such rule or variant
    Fault             the scenario does not run over ROS
    """
    if name in SCENARIOS and name not in bringups():
        raise Fault(f"The scenario {name} runs in the library only: track-fusion reproduce {name}.")
    bringup = Bringup(name)
    scenario, row = get_scenario(bringup.scenario), ROWS[bringup.filter]
    known = [c.name for c in scenario.rules]
    own = RULES if set(RULES) <= set(known) else tuple(c.name for c in scenario.rules if not c.variant)
    for rule in rules:
        if "@" in rule and rule not in known:
            raise unknown_name_error(rule, known, "rule of this scenario")
        get_rule(rule.partition("@")[0])
    runs = library_runs or (FAST_RUNS if row == "kf" else scenario.default_runs)
    return Demo(name, scenario, row, rules or own, out, seed, runs)
