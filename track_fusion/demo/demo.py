"""The demonstration: a published scenario run by real nodes, recorded, judged and drawn."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from track_fusion.demo.figures import figures, library
from track_fusion.demo.over_ros import Progress, over_ros
from track_fusion.demo.picture import picture
from track_fusion.demo.plan import Demo
from track_fusion.params import Fault

#: What a demonstration writes; only a folder with nothing else is cleared.
RESULTS = ("bag", "figures.json", "tracks.png", "nodes_*.log", "evaluation_*.json")


def run_demo(demo: Demo, progress: Progress) -> dict[str, Any]:
    """Run all, write bag, figures.json and picture; return what figures.json holds.

    Parameters
    ----------
    demo : Demo
    progress : callable    (what is being done, done share of it)

    Raises
    ------
    Fault    a node failed or hung; the message names its log; or `out` holds something else than earlier results
    """
    clear(demo.out)
    rules = demo.rules if demo.many_targets else (None, *demo.rules)
    measured = {rule or "alone": over_ros(demo, rule, progress) for rule in rules}
    rows, label = [f"{demo.row}-{name}" for name in measured], f"library, {demo.library_runs} runs"
    result = figures(demo, measured, *library(demo, rows, lambda share: progress(label, share)))
    (demo.out / "figures.json").write_text(json.dumps(result, indent=1, allow_nan=False) + "\n")
    picture(demo)
    return result


def clear(out: Path) -> None:
    """Make an empty folder, of earlier results if there are any, and of nothing else."""
    if out.exists() and not out.is_dir():
        raise Fault(f"{out} is no folder.")
    foreign = [p.name for p in sorted(out.glob("*")) if not any(p.match(pattern) for pattern in RESULTS)]
    if foreign:
        raise Fault(f"{out} holds {foreign[0]}, which is no result of a demonstration: it would be deleted.")
    if out.exists():
        shutil.rmtree(out)
    out.mkdir(parents=True)
