"""The figures of a demonstration: over ROS, of the same one run by the library, and of many library runs."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from track_fusion.demo.plan import Demo
from track_fusion.metrics.accuracy import Estimate
from track_fusion.params import ParameterError
from track_fusion.study.judgement import judged_figures

Figures = dict[str, Estimate]


def library(demo: Demo, rows: list[str], progress: Callable[[float], None]) -> tuple[Figures, Figures]:
    """Measure the rows that the scenario has, over the first run alone and over all; it may not know every rule.

    Rows of many targets share the tracks, the costly part, and are studied at once. Of one target, what all sensors
    together would give (IC) is measured for comparison.
    """
    wanted = [f"{demo.row}-"] if demo.many_targets else [*rows, f"{demo.row}-ic"]
    same: Figures = {}
    many: Figures = {}
    for done, only in enumerate(wanted):

        def part(share: float, done: int = done) -> None:
            progress((done + share) / len(wanted))

        try:
            outcomes = demo.scenario.simulate(range(demo.library_runs), demo.seed, part, only)
        except ParameterError:
            continue
        for measured, runs in ((same, 1), (many, demo.library_runs)):
            measured |= demo.scenario.figures({name: array[:runs] for name, array in outcomes.items()})
    progress(1.0)
    return same, many


def figures(demo: Demo, over_ros: dict[str, dict[str, float]], same: Figures, many: Figures) -> dict[str, Any]:
    """Bring all into the form of `reproduce`: ros/ and library/ are the same one run, library/...@N-runs the study.

    The standard error of one run is the spread of a run in the study.
    """
    scenario = demo.scenario
    listed: list[dict[str, Any]] = []
    known = {name.rpartition("/")[2] for name in many}
    for rule, measured in over_ros.items():
        for quantity in [q for q in measured if q in known or not known]:
            name = f"{demo.row}-{rule}/{quantity}"
            spread = many[name].spread(1) if name in many else math.nan
            single = {"ros": measured[quantity]} | ({"library": same[name].value} if name in same else {})
            for path, value in single.items():
                (figure,) = judged_figures(scenario, {name: Estimate(value, spread, 1)})
                listed.append({**figure, "name": f"{path}/{name}"})
    for figure in judged_figures(scenario, many):
        name = figure["name"]
        row, _, quantity = name.rpartition("/")
        variant = f"{row},{demo.library_runs}-runs" if "@" in row else f"{row}@{demo.library_runs}-runs"
        listed.append({**figure, "name": f"library/{variant}/{quantity}"})
    run = {"scenario": scenario.key, "parameter_file": demo.name, "runs": 1, "seed": demo.seed}
    return {**run, "library_runs": demo.library_runs, "figures": listed}
