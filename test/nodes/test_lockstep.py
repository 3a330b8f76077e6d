"""The scenario in lockstep over real processes: the same to the last bit, equal to the library, clear when stuck."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from nodes.support import START_S, STEP_S, positions, stamp_ns
from numpy.typing import NDArray
from rclpy.context import Context
from ros_helpers import NodeProcess, Probe, own_domain
from sensor_msgs.msg import PointCloud2

from track_fusion.demo.bringup import Nodes, local_environment, running, start_scenario
from track_fusion.scenarios.li2022 import linear as li2022_linear
from track_fusion.study.one_target import drawn

SCENARIO = "li2022-linear"
FUSED = "/fusion_centre/tracks"
SEED, RUN = 7, 3
STEPS, REPEATS = 1000, 5
RUN_S = 300.0  # five runs at once take 20 s on two idle cores; tests of others may be running
TOLERANCE = 1e-9


@contextmanager
def scenario(
    domain: int,
    log: Path,
    rule: str | None,
    steps: int,
    overrides: Mapping[str, Mapping[str, Any]],
    evaluator: bool = True,
) -> Iterator[Nodes]:
    """Run the scenario's processes; the test listens to the fused tracks, too."""
    fused_by = "fusion_centre" if rule else "sensor_1"
    given: dict[str, dict[str, Any]] = {name: dict(values) for name, values in overrides.items()}
    given.setdefault("replay", {}).update(seed=SEED, run=RUN, steps=steps, deadline_s=START_S)
    for name in ("sensor_1", "sensor_2", "fusion_centre"):
        given.setdefault(name, {}).update(subscribers_deadline_s=START_S)
    for name in ("sensor_1", "sensor_2"):
        given[name].update(feedback_timeout_s=START_S)
    given.setdefault("evaluator", {}).update(steps=steps)
    given.setdefault(fused_by, {}).update(expected_subscribers=(4 if rule else 2) + evaluator)
    with running(local_environment(domain), log) as nodes:
        start_scenario(nodes, SCENARIO, rule, given, evaluator)
        yield nodes


def collect(
    probe: Probe, nodes: Nodes, log: Path, messages: list[Any], steps: int, also: Callable[[], object] = lambda: True
) -> None:
    """Wait for all steps; a node that fails ends the wait with its words."""

    def done() -> bool:
        assert nodes.failed() is None, f"{nodes.failed()} failed: {log.read_text()}"
        also()
        return len(messages) >= steps

    try:
        probe.wait_for(done, RUN_S, f"{steps} steps")
    except TimeoutError as error:
        raise TimeoutError(f"{error} {len(messages)} came. {log.read_text()}") from None
    for name in {"replay", "evaluator"} & set(nodes.processes):
        assert nodes.processes[name].wait(STEP_S) == 0, log.read_text()


def check_stamps(messages: list[PointCloud2], steps: int) -> None:
    assert [stamp_ns(m) for m in messages] == [k * 1_000_000_000 for k in range(1, steps + 1)]
    assert all(m.width == 1 for m in messages)


def run_once(log: Path) -> list[PointCloud2]:
    """Run the scenario once, in a domain of its own; return the fused tables."""
    with own_domain(range(1, 102)) as domain:
        context = Context()
        rclpy.init(context=context, domain_id=domain)
        try:
            with Probe(context) as probe:
                messages = probe.listen(FUSED, PointCloud2, 2000)
                overrides = {"replay": {"expected_truth_subscribers": 0}}
                with scenario(domain, log, "covariance_intersection", STEPS, overrides, evaluator=False) as nodes:
                    collect(probe, nodes, log, messages, STEPS)
        finally:
            context.try_shutdown()
    check_stamps(messages, STEPS)
    return messages


@pytest.fixture(scope="module")
def once(tmp_path_factory: pytest.TempPathFactory) -> list[PointCloud2]:
    """Run 1000 steps."""
    return run_once(tmp_path_factory.mktemp("lockstep") / "nodes.log")


@pytest.mark.slow
def test_five_repeats_of_1000_steps_are_bit_identical(tmp_path_factory: pytest.TempPathFactory) -> None:
    """With other processes each time, and all at once: they disturb each other's timing."""
    logs = [tmp_path_factory.mktemp("lockstep") / "nodes.log" for _ in range(REPEATS)]
    with ThreadPoolExecutor(REPEATS) as pool:
        repeats = list(pool.map(run_once, logs))
    first = [m.data.tobytes() for m in repeats[0]]
    assert len(set(first)) == STEPS
    for other in repeats[1:]:
        assert [m.data.tobytes() for m in other] == first


def test_late_feedback_changes_nothing(
    once: list[PointCloud2], ros_context: Any, ros_domain: int, tmp_path: Path
) -> None:
    """Feedback passes through the test, which lets it go to a tracker only after the tracker has its next detection."""
    steps, log = 200, tmp_path / "nodes.log"
    sensors = ("sensor_1", "sensor_2")
    with Probe(ros_context) as probe:
        messages = probe.listen(FUSED, PointCloud2, 2000)
        relay = Relay(probe, sensors)
        overrides = {s: {"feedback_timeout_s": RUN_S} for s in sensors}
        with running(local_environment(ros_domain), log) as nodes:
            start_relayed(nodes, overrides, steps)
            collect(probe, nodes, log, messages, steps, relay.forward)
    check_stamps(messages, steps)
    assert [m.data.tobytes() for m in messages] == [m.data.tobytes() for m in once[:steps]]
    # Of the last step there is no next detection, so its feedback never went.
    assert relay.late == dict.fromkeys(sensors, steps - 1)


class Relay:
    """Passes fused tracks on to each tracker's feedback, one step late."""

    def __init__(self, probe: Probe, sensors: tuple[str, ...]) -> None:
        self._fused = probe.listen(FUSED, PointCloud2, 2000)
        self._seen = {s: probe.listen(f"/replay/{s}/detections", PointCloud2, 2000) for s in sensors}
        self._out = {s: probe.node.create_publisher(PointCloud2, f"/late/{s}", 2000) for s in sensors}
        self.late = dict.fromkeys(sensors, 0)

    def forward(self) -> None:
        """Hand on what is late enough: the feedback of a step once the detection of the next one is on its way."""
        for sensor, out in self._out.items():
            while self.late[sensor] < min(len(self._fused), len(self._seen[sensor]) - 1):
                out.publish(self._fused[self.late[sensor]])
                self.late[sensor] += 1


def start_relayed(nodes: Nodes, overrides: Mapping[str, Mapping[str, Any]], steps: int) -> None:
    """Start the scenario with each tracker's feedback remapped to the relay."""
    from track_fusion.demo import bringup

    plain = bringup.ros_arguments

    def relayed(name: str, config: Any, params: Any, remaps: Mapping[str, str]) -> list[str]:
        late = {k: f"/late/{name}" if k == "~/feedback" else v for k, v in remaps.items()}
        return plain(name, config, params, late)

    given: dict[str, dict[str, Any]] = {
        **{name: dict(values) for name, values in overrides.items()},
        # The relay listens to the detections, too; the relay and the test stand for the two trackers at the centre.
        "replay": {"seed": SEED, "run": RUN, "steps": steps, "deadline_s": START_S, "expected_subscribers_each": 2},
        "evaluator": {"steps": steps},
        "fusion_centre": {"expected_subscribers": 4},
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bringup, "ros_arguments", relayed)
        start_scenario(nodes, SCENARIO, "covariance_intersection", given)


def library(rule: str | None) -> NDArray[np.float64]:
    """Run the library on the same draws: estimated states of all steps, (T, n)."""
    tracking = li2022_linear.TRACKING
    row = li2022_linear.KALMAN_ROWS[f"kf-{rule or 'alone'}"]
    return np.array([fused.mean[0] for fused in row.estimates(drawn(tracking, [RUN], SEED))])


def compare_with_library(messages: list[PointCloud2], rule: str | None) -> None:
    expected = library(rule)
    estimated = np.array([positions(m)[0] for m in messages[: len(expected)]])
    assert expected.shape == (100, 4)
    np.testing.assert_allclose(estimated, expected, rtol=0, atol=TOLERANCE * np.abs(expected).max())


def test_covariance_intersection_agrees_with_the_library(once: list[PointCloud2]) -> None:
    compare_with_library(once, "covariance_intersection")


@pytest.mark.parametrize(
    "rule",
    ["arithmetic_average", None, *(pytest.param(r, marks=pytest.mark.slow) for r in ("naive", "covariance_union"))],
)
def test_the_nodes_agree_with_the_library(rule: str | None, ros_context: Any, ros_domain: int, tmp_path: Path) -> None:
    log, judged = tmp_path / "nodes.log", tmp_path / "judged.json"
    with Probe(ros_context) as probe:
        messages = probe.listen(FUSED if rule else "/sensor_1/tracks", PointCloud2, 2000)
        with scenario(ros_domain, log, rule, 100, {"evaluator": {"output": str(judged)}}) as nodes:
            collect(probe, nodes, log, messages, 100)
    check_stamps(messages, 100)
    compare_with_library(messages, rule)
    error = library(rule) - li2022_linear.TRACKING.truth(SEED, RUN)[1:]
    result = json.loads(judged.read_text())
    assert (result["times"], result["missed"], result["false"]) == (100, 0, 0)
    for name, at in (("position_armse_m", slice(0, 2)), ("velocity_armse_mps", slice(2, 4))):
        assert result["all"][name] == pytest.approx(np.linalg.norm(error[:, at], axis=1).mean(), rel=TOLERANCE)


def test_a_run_continues_beyond_the_scenario(once: list[PointCloud2]) -> None:
    """The first steps do not depend on how many there are; later ones go on with the same target."""
    tracking = li2022_linear.TRACKING
    truth = tracking.truth(SEED, RUN, STEPS)
    np.testing.assert_array_equal(truth[: tracking.steps + 1], tracking.truth(SEED, RUN))
    error = np.array([positions(m)[0] for m in once]) - truth[1:]
    assert np.linalg.norm(error[-100:, :2], axis=1).mean() < 40.0  # the scenario's own figure is 19 m


def test_a_missing_participant_is_named(ros_domain: int) -> None:
    """Nobody takes sensor_2's detections and nobody fuses; and one that is there but never answers."""
    params = {"deadline_s": 3.0, "steps": 5}
    with ExitStack() as stack:
        alone = stack.enter_context(NodeProcess("replay", node="alone", params=params))
        listeners = {"~/detections": "/stuck/sensor_1/detections", "~/tracks": "/nowhere"}
        stack.enter_context(NodeProcess("sensor_tracker", node="sensor_1", remaps=listeners))
        mute = {"~/sources/sensor_1/tracks": "/unheard", "~/tracks": "/stuck/fused"}
        stack.enter_context(NodeProcess("fusion_centre", remaps=mute))
        stuck = stack.enter_context(NodeProcess("replay", node="stuck", params=params | {"sensors": ["sensor_1"]}))
        assert alone.wait(START_S) == 1
        said = alone.output()
        for topic in ("/alone/sensor_1/detections has no subscriber", "/alone/fused has no publisher"):
            assert topic in said
        assert "Traceback" not in said
        assert stuck.wait(START_S) == 1
        assert "no result of step 1 on /stuck/fused. All topics are connected." in stuck.output()
