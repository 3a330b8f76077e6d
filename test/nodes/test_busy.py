"""On a machine with other work to do every sample is judged: the radar scenario over ROS beside two busy processes.

TRACK_FUSION_BUSY_RUNS=50 python -m pytest test/nodes/test_busy.py
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nodes.scenario_runs import RADAR_STEPS, RADARS, RUN, SEED, Case, run

from track_fusion.scenarios.sharma import radar_runs
from track_fusion.study.one_target import Row

RUNS = int(os.environ.get("TRACK_FUSION_BUSY_RUNS", "2"))
BUSY = 2


@contextmanager
def busy_processes() -> Iterator[None]:
    """Keep as many processors busy as a small machine has."""
    with ExitStack() as stack:
        for _ in range(BUSY):
            process = stack.enter_context(subprocess.Popen([sys.executable, "-S", "-c", "while True: pass"]))
            stack.callback(process.kill)
        yield


@pytest.mark.slow
@pytest.mark.parametrize("repetition", range(RUNS))
def test_every_sample_of_the_radars_is_judged(
    repetition: int, ros_context: Any, ros_domain: int, tmp_path: Path
) -> None:
    pytest.importorskip("pymap3d")
    case = Case(RADARS, "harmonic_mean", "", Row(lambda draws: iter(())), steps=RADAR_STEPS)
    with busy_processes():
        messages, judged = run(case, ros_context, ros_domain, tmp_path)
    states = radar_runs.scene().states(SEED, RUN)[:: radar_runs.FUSION_SCANS][1 : len(messages) + 1]
    targets = int(np.isfinite(states).all(-1).sum())
    assert judged["times"] == len(messages) == RADAR_STEPS // radar_runs.FUSION_SCANS
    assert (judged["unjudged"], judged["unjudged_times"]) == (0, 0)
    assert judged["all"]["samples"] + judged["missed"] == targets
