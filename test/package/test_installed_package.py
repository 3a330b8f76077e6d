"""A package with a rule, a motion and a message type: a fusion centre runs by them, and refuses what is wrong."""

from __future__ import annotations

import os
import re
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from nodes.support import PATIENT, SECOND_NS, START_S, STEP_S, clock, read
from package.packages import install
from ros_helpers import NodeProcess, Probe
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from msg_adapters.header import make_header

ROOT = Path(__file__).resolve().parents[2]

MOTION = '''
"""Targets that walk at random."""

import dataclasses

import numpy as np

from track_fusion.models.base import Transition
from track_fusion.models.choices import Choice
from track_fusion.params import Params, param


@dataclasses.dataclass(frozen=True)
class WalkParams(Params):
    """How fast they walk."""

    walk_sd: float = param(1.0, "standard deviation of the way of a second, any axis", low=0.0)


class Walk:
    def __init__(self, layout, params):
        self.layout, self._noise = layout, params.walk_sd**2 * np.eye(layout.size)

    def over(self, dt):
        return Transition.linear(np.eye(self.layout.size), dt * self._noise)


WALK = Choice(WalkParams, Walk)
'''
ADAPTER = '''
"""Poses as tracks of the axes x and y."""

from msg_adapters.types import MessageType, Reading


def read(msg, axes, cross_block):
    from msg_adapters.pose import pose_from_msg

    return Reading(pose_from_msg(msg, axes))


POSE = MessageType("geometry_msgs/msg/PoseWithCovarianceStamped", read)
ALIEN = MessageType("no_such_msgs/msg/Thing", read)
'''
CONFIGURATION = """
fusion_centre:
  ros__parameters:
    axes: ["x", "y"]
    source_configurations: [a, b]
    source_types: [pose, pose]
    motion: walk
    walk_sd: 3.0
    state_fusion: best_track
    best_track.criterion: trace
    trigger: any_source
    max_scan_age_s: 5.0
    confirmation_threshold: [1, 1]
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of installed packages: one that works, and one whose rules do not."""
    site = tmp_path_factory.mktemp("site")
    (rule,) = re.findall(r"```python\n(.*?)```", (ROOT / "doc" / "add-a-rule.md").read_text(), re.DOTALL)
    points = {
        "track_fusion.rules": {"best_track": "best_track:RULE"},
        "track_fusion.motions": {"walk": "walk:WALK"},
        "track_fusion.adapters": {"pose": "poses:POSE", "alien": "poses:ALIEN"},
    }
    install(site, "good-plugin", points, {"best_track": rule, "walk": MOTION, "poses": ADAPTER})
    points = {
        "track_fusion.rules": {"broken": "bad_rules:RULE", "naive": "bad_rules:RULE"},
        "track_fusion.motions": {"walk_back": "bad_rules:WALK"},
    }
    install(site, "bad-plugin", points, {"bad_rules": "import a_library_that_is_missing"})
    return site


@pytest.fixture
def environment(site: Path) -> dict[str, str]:
    """Where processes find the packages, too."""
    return {"PYTHONPATH": os.pathsep.join([str(site), os.environ.get("PYTHONPATH", "")])}


def pose(stamp_ns: int, x: float, variance: float) -> PoseWithCovarianceStamped:
    msg = PoseWithCovarianceStamped(header=make_header(stamp_ns, "map"))
    msg.pose.pose.position.x = x
    msg.pose.covariance = (variance * np.eye(6)).ravel()
    return msg


def test_a_fusion_centre_runs_by_what_the_package_brings(
    ros_context: Any, environment: dict[str, str], tmp_path: Path
) -> None:
    """The sharper of two tracks is taken, a second's walk of 3 m considered; the broken package disturbs nobody."""
    file, start = tmp_path / "centre.yaml", 10 * SECOND_NS
    file.write_text(CONFIGURATION)
    params = {k: v for k, v in PATIENT.items() if k not in ("axes", "trigger")}
    with (
        NodeProcess("fusion_centre", params=params, params_file=file, env=environment),
        Probe(ros_context) as probe,
    ):
        tracks = probe.listen("/fusion_centre/tracks", PointCloud2)
        told = probe.publisher("/clock", Clock, deadline_s=START_S)
        kind = PoseWithCovarianceStamped
        sources = [probe.publisher(f"/fusion_centre/sources/{s}/tracks", kind, deadline_s=START_S) for s in "ab"]
        probe.wait_for_publisher("/fusion_centre/tracks", deadline_s=START_S)

        def fused(count: int) -> bool:
            told.publish(clock(start + (count - 1) * SECOND_NS))  # again and again: a clock is best-effort
            return len(tracks) >= count

        for k, (x, variance) in enumerate([(0.0, 1.0), (1.0, 4.0)]):
            sources[k].publish(pose(start + k * SECOND_NS, x, variance))
            probe.wait_for(lambda count=k + 1: fused(count), STEP_S, f"the fusion of scan {k}")  # type: ignore[misc]
        first, second = map(read, tracks)
    np.testing.assert_allclose(first.mean[0, 0], [0.0, 0.0])
    np.testing.assert_allclose(first.cov[0, 0], np.eye(2))
    # By then the first track's variance is 1 + 3^2: the second's 4 is less.
    np.testing.assert_allclose(second.mean[0, 0], [1.0, 0.0])
    np.testing.assert_allclose(second.cov[0, 0], 4.0 * np.eye(2))
    assert second.track_id.tolist() == first.track_id.tolist()


#: Parameters, and what the one line must say.
REFUSED: list[tuple[dict[str, Any], str]] = [
    (
        {"state_fusion": "broken"},
        "The rule 'broken' of the package 'bad-plugin' (entry point bad_rules:RULE in track_fusion.rules) cannot be "
        "loaded: ModuleNotFoundError: No module named 'a_library_that_is_missing'",
    ),
    (
        {"state_fusion": "naive"},
        "The rule 'naive' must have a key of its own. Got it from track_fusion and the package 'bad-plugin' (entry "
        "point bad_rules:RULE in track_fusion.rules).",
    ),
    ({"motion": "walk_back"}, "The motion 'walk_back' of the package 'bad-plugin'"),
    ({"state_fusion": "best_trak"}, "Did you mean 'best_track'?"),
    ({"motion": "wlak"}, "Did you mean 'walk'?"),
    ({"source_types": ["track_table", "poes"]}, "Did you mean 'pose'?"),
    ({"source_types": ["track_table", "alien"]}, "The 'source_types' parameter: Messages of the type "
     "no_such_msgs/msg/Thing need the package 'no_such_msgs' (No module named 'no_such_msgs'). Install "
     "ros-jazzy-no-such-msgs."),
    ({"state_fusion": "best_track", "best_track.criterium": "det"}, "Did you mean 'best_track.criterion'?"),
]  # fmt: skip


def test_what_is_wrong_is_refused_in_one_line(ros_domain: int, environment: dict[str, str]) -> None:
    with ExitStack() as stack:
        started = [stack.enter_context(NodeProcess("fusion_centre", params=p, env=environment)) for p, _ in REFUSED]
        for process, (params, wanted) in zip(started, REFUSED, strict=True):
            assert process.wait(START_S) == 2, (params, process.output())
            (line,) = process.output().strip().splitlines()
            assert wanted in line
