"""The life of nodes: parameters refused, signals, transitions, the clock jumping back, late scans, a tracker killed."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from nav_msgs.msg import Odometry
from nodes.support import (
    AXES,
    PATIENT,
    SECOND_NS,
    START_S,
    STEP_S,
    Diagnostics,
    clock,
    detections,
    read,
    stamp_ns,
    track_table,
)
from ros_helpers import NodeProcess, Probe, wait_until
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from msg_adapters.odometry import odometry_to_msgs
from msg_adapters.track_table import track_table_to_msg
from track_fusion.tracks import TrackBatch, planar_layout

# ---- start and end -----------------------------------------------------------------------------------------------

#: Executable, parameter given, what the one line must say.
REFUSED: list[tuple[str, dict[str, Any], str]] = [
    ("fusion_centre", {"fusion_timout_s": 1.0}, "'fusion_timout_s'. Did you mean 'fusion_timeout_s'?"),
    (
        "fusion_centre",
        {"covariance_intersection.criterium": "det"},
        "Did you mean 'covariance_intersection.criterion'?",
    ),
    ("fusion_centre", {"state_fusion": "covariance_intersecton"}, "Did you mean 'covariance_intersection'?"),
    ("fusion_centre", {"gate_probability": 1.5}, "The 'gate_probability' parameter must be a number > 0"),
    ("sensor_tracker", {"procss_noise": 1.0}, "Did you mean 'process_noise'?"),
    ("sensor_tracker", {"sensor_sd": "wide"}, "The 'sensor_sd' parameter must be a number > 0. Got 'wide'."),
    ("sensor_tracker", {"filter": "cubatur"}, "Did you mean 'cubature'?"),
    ("sensor_tracker", {"motion": "coordinated"}, "Did you mean 'coordinated_turn'?"),
    ("sensor_tracker", {"motion": "coordinated_turn"}, "Coordinated turn needs axes x, y, vx, vy, turn_rate."),
    ("sensor_tracker", {"sensor": "range_bearing"}, "The 'filter' parameter must be one for non-linear models"),
    ("sensor_tracker", {"particles": 100}, "Unknown parameter 'particles'."),
    ("sensor_tracker", {"filter": "pda"}, "The 'sensor' parameter must be 'range_bearing' with filter 'pda'."),
    ("fusion_centre", {"particle_variances": [1.0]}, "The 'particle_variances' parameter must hold 4 numbers"),
    ("replay", {"sceanrio": "li2022-linear"}, "Did you mean 'scenario'?"),
    ("replay", {"sensors": ["sensor_1", "sensor_9"]}, "Unknown sensor 'sensor_9'."),
    ("evaluator", {"outptu": "x.json"}, "Did you mean 'output'?"),
    (
        "fusion_centre",
        {"harmonic_mean.samples": 3},
        "The 'harmonic_mean.samples' parameter belongs to 'harmonic_mean', but state_fusion is "
        "'covariance_intersection'.",
    ),
    ("fusion_centre", {"state_fusion": "mixture_exact"}, "The 'state_fusion' parameter must be one of 'naive',"),
    ("evaluator", {"truth_type": "odometrie"}, "Did you mean 'odometry'?"),
    ("evaluator", {"steps": -1}, "The 'steps' parameter must be an integer >= 0. Got -1."),
]


@pytest.mark.colcon
def test_wrong_parameters_stop_the_start_with_one_line(ros_domain: int) -> None:
    with ExitStack() as stack:
        started = [stack.enter_context(NodeProcess(name, params=params)) for name, params, _ in REFUSED]
        for process, (name, params, wanted) in zip(started, REFUSED, strict=True):
            assert process.wait(START_S) == 2, (name, params, process.output())
            (line,) = process.output().strip().splitlines()
            assert wanted in line


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
def test_a_signal_during_start_ends_a_node_with_code_0(number: int, ros_domain: int) -> None:
    """From the moment at which rclpy handles signals; before, the interpreter is still loading modules."""

    def handles_signals(process: NodeProcess) -> bool:
        status = Path(f"/proc/{process.pid}/status").read_text()
        caught = int(next(line for line in status.splitlines() if line.startswith("SigCgt")).split()[1], 16)
        return bool(caught >> (signal.SIGTERM - 1) & 1)

    with ExitStack() as stack:
        names = ("fusion_centre", "sensor_tracker", "replay", "evaluator")
        started = [stack.enter_context(NodeProcess(name)) for name in names]
        for process in started:
            wait_until(lambda p=process: handles_signals(p), START_S, f"{process.name} to handle signals")  # type: ignore[misc]
            process.send(number)
        assert {p.name: p.wait(STEP_S) for p in started} == dict.fromkeys(names, 0)
        assert all("Traceback" not in p.output() for p in started)


# ---- nodes that the following tests share ------------------------------------------------------------------------


class Set:
    """The shared nodes, each on a clock of its own where it needs one."""

    def __init__(self, probe: Probe, processes: dict[str, NodeProcess], folder: Path) -> None:
        self.probe, self.processes, self.folder = probe, processes, folder
        self.diagnostics = Diagnostics(probe)

    def publisher(self, topic: str, kind: type, readers: int = 1) -> Any:
        return self.probe.publisher(topic, kind, readers=readers, deadline_s=START_S)

    def await_count(self, messages: list[Any], count: int, what: str, ticker: Any = None, now_ns: int = 0) -> None:
        """Wait for so many messages, telling the time meanwhile."""

        def arrived() -> bool:
            if ticker is not None:
                ticker.publish(clock(now_ns))
            return len(messages) >= count

        self.probe.wait_for(arrived, STEP_S, what)
        assert len(messages) == count, what

    def change(self, node: str, transition: int) -> None:
        request = ChangeState.Request(transition=Transition(id=transition))
        assert self.probe.call(f"/{node}/change_state", ChangeState, request, START_S).success


@pytest.fixture(scope="module")
def nodes(shared_domain: int, shared_probe: Probe, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Set]:
    one = PATIENT | {"confirmation_threshold": [1, 1], "source_configurations": ["a"]}
    two = PATIENT | {"confirmation_threshold": [1, 1], "source_configurations": ["a", "b"], "trigger": "any_source"}
    folder = tmp_path_factory.mktemp("judged")
    # A detection may overtake the clock that tells its time.
    tracker = {"use_sim_time": True, "axes": list(AXES), "max_future_s": 10.0}
    chosen: list[tuple[str, str, dict[str, Any]]] = [
        ("fusion_centre", "managed", one | {"use_sim_time": False, "autostart": False, "max_delay_s": 1e10}),
        ("fusion_centre", "neglecting", two | {"out_of_sequence": "neglect"}),
        ("fusion_centre", "predicting", two | {"out_of_sequence": "predict", "fusion_timeout_s": 0.0}),
        ("fusion_centre", "jumping_centre", one),
        ("sensor_tracker", "jumping_tracker", tracker),
        ("evaluator", "judge", {"output": str(folder / "judge.json")}),
        ("evaluator", "doubter", {"output": str(folder / "doubter.json"), "truth_type": "odometry"}),
    ]
    with ExitStack() as stack:
        processes = {}
        for executable, name, params in chosen:
            own_clock = {"/clock": f"/{name}/clock"} if params.get("use_sim_time") else {}
            process = NodeProcess(executable, node=name, params=params, remaps=own_clock)
            processes[name] = stack.enter_context(process)
        yield Set(shared_probe, processes, folder)


# ---- transitions -------------------------------------------------------------------------------------------------


def test_an_inactive_node_processes_nothing(nodes: Set) -> None:
    probe, base_ns = nodes.probe, 5 * SECOND_NS
    fused = probe.listen("/managed/tracks", PointCloud2)
    assert probe.state("/managed", START_S) == "unconfigured"
    assert probe.node.count_subscribers("/managed/sources/a/tracks") == 0
    nodes.change("managed", Transition.TRANSITION_CONFIGURE)
    assert probe.state("/managed") == "inactive"
    source = nodes.publisher("/managed/sources/a/tracks", PointCloud2)

    def send(step: int, ignored: bool) -> None:
        source.publish(track_table(base_ns + step * SECOND_NS, [step, 0.0, 0.0, 0.0]))
        if ignored:
            assert source.wait_for_all_acked()
            for _ in range(2):  # the second answer comes after all that was there before the first
                probe.state("/managed")

    def fused_times() -> list[int]:
        return [(stamp_ns(m) - base_ns) // SECOND_NS for m in fused]

    send(0, ignored=True)
    values = nodes.diagnostics.wait_for(
        "managed", lambda v: v.get("active") == "False", "a report of the inactive node"
    )
    assert "steps" not in values
    nodes.change("managed", Transition.TRANSITION_ACTIVATE)
    send(1, ignored=False)
    nodes.await_count(fused, 1, "the scan sent to the active node")
    nodes.change("managed", Transition.TRANSITION_DEACTIVATE)
    send(2, ignored=True)
    nodes.change("managed", Transition.TRANSITION_ACTIVATE)
    send(3, ignored=False)
    nodes.await_count(fused, 2, "the scan sent to the node made active again")
    assert fused_times() == [1, 3]
    assert [read(m).track_id.tolist() for m in fused] == [[1], [1]]
    nodes.change("managed", Transition.TRANSITION_ACTIVE_SHUTDOWN)
    send(4, ignored=True)
    assert fused_times() == [1, 3]
    assert nodes.processes["managed"].stop() == 0


# ---- time --------------------------------------------------------------------------------------------------------


@pytest.mark.colcon
def test_late_scans_are_neglected_or_predicted(nodes: Set) -> None:
    """Both centres hear a at 10.0 s, then b of 9.9 s, then b of 10.1 s."""
    scan = {at: track_table(at * SECOND_NS // 10, [at * 0.1, 0.0, 1.0, 0.0]) for at in (99, 100, 101)}
    for name in ("neglecting", "predicting"):
        fused = nodes.probe.listen(f"/{name}/tracks", PointCloud2)
        ticker = nodes.publisher(f"/{name}/clock", Clock)
        a, b = (nodes.publisher(f"/{name}/sources/{s}/tracks", PointCloud2) for s in "ab")
        time = {"ticker": ticker, "now_ns": 10 * SECOND_NS}
        a.publish(scan[100])
        nodes.await_count(fused, 1, "the first step", **time)
        b.publish(scan[99])
        if name == "predicting":
            nodes.await_count(fused, 2, "a second step just after 10 s", **time)
            late = read(fused[-1])
            assert (stamp_ns(fused[-1]), late.source.tolist()) == (10 * SECOND_NS + 1, [3])
            np.testing.assert_allclose(late.mean[0, 0], [10.0 + 1e-9, 0.0, 1.0, 0.0], rtol=1e-12)
        else:
            nodes.diagnostics.wait_for_counts(name, {"late_scan": 1})
        b.publish(scan[101])
        nodes.await_count(fused, 2 + (name == "predicting"), "the last step", **time)
        assert stamp_ns(fused[-1]) == 101 * SECOND_NS // 10
        assert nodes.diagnostics.rejected(name) == ({} if name == "predicting" else {"late_scan": 1})


def test_a_clock_that_jumps_back_starts_the_centre_anew(nodes: Set) -> None:
    fused = nodes.probe.listen("/jumping_centre/tracks", PointCloud2)
    ticker = nodes.publisher("/jumping_centre/clock", Clock)
    source = nodes.publisher("/jumping_centre/sources/a/tracks", PointCloud2)
    far_apart = [[0.0, 0.0, 0.0, 0.0], [500.0, 0.0, 0.0, 0.0]]
    for k, means in enumerate((far_apart[:1], far_apart)):
        now_ns = (100 + k) * SECOND_NS
        source.publish(track_table(now_ns, means))
        nodes.await_count(fused, k + 1, "a step before the jump", ticker, now_ns)
    assert read(fused[-1]).track_id.tolist() == [1, 2]
    ticker.publish(clock(50 * SECOND_NS))
    nodes.diagnostics.wait_for("jumping_centre", lambda v: v.get("clock_jumps") == "1", "the jump to be counted")
    source.publish(track_table(50 * SECOND_NS, far_apart[1:]))
    nodes.await_count(fused, 3, "a step after the jump", ticker, 50 * SECOND_NS)
    # What was is forgotten, but for the identifiers: none is given again.
    assert (stamp_ns(fused[-1]), read(fused[-1]).track_id.tolist()) == (50 * SECOND_NS, [3])
    assert read(fused[-1]).mean[0, 0].tolist() == far_apart[1]
    assert nodes.diagnostics.rejected("jumping_centre") == {}


def test_a_clock_that_jumps_back_starts_the_tracker_anew(nodes: Set) -> None:
    tracks = nodes.probe.listen("/jumping_tracker/tracks", PointCloud2)
    ticker = nodes.publisher("/jumping_tracker/clock", Clock)
    source = nodes.publisher("/jumping_tracker/detections", PointCloud2)
    for k in range(3):
        now_ns = (100 + k) * SECOND_NS
        source.publish(detections(now_ns, [1.0, 2.0]))
        nodes.await_count(tracks, k + 1, "a step before the jump", ticker, now_ns)
    ticker.publish(clock(50 * SECOND_NS))
    nodes.diagnostics.wait_for("jumping_tracker", lambda v: v.get("clock_jumps") == "1", "the jump to be counted")
    source.publish(detections(50 * SECOND_NS, [1.0, 2.0]))
    nodes.await_count(tracks, 4, "a step after the jump", ticker, 50 * SECOND_NS)
    assert tracks[3].data.tobytes() == tracks[0].data.tobytes()
    assert tracks[2].data.tobytes() != tracks[0].data.tobytes()


# ---- the evaluator -----------------------------------------------------------------------------------------------


def publish_judged(nodes: Set, name: str, error_m: float) -> None:
    """Send 30 times a truth and a track that is off by `error_m` with a standard deviation of 1 m."""
    whole = name == "judge"  # the other one gets its truth target by target
    truth = nodes.publisher(f"/{name}/truth", PointCloud2 if whole else Odometry)
    tracks = nodes.publisher(f"/{name}/tracks", PointCloud2)
    for k in range(30):
        at_ns = (1 + k) * SECOND_NS
        state = np.array([[10.0 * k, 0.0, 10.0, 0.0]])
        batch = TrackBatch.gaussian(planar_layout(), "map", state, 1e-12 * np.eye(4)[None], time_ns=at_ns, track_id=[1])
        for msg in [track_table_to_msg(batch, AXES, at_ns)] if whole else odometry_to_msgs(batch, AXES):
            truth.publish(msg)
        # All four axes are off by one standard deviation, or that times error_m: the NEES is 4 error_m^2.
        tracks.publish(track_table(at_ns, state + error_m * np.array([[1.0, -1.0, 1.0, -1.0]]), ids=[5]))
    nodes.diagnostics.wait_for(name, lambda v: v.get("times") == "30", "30 times to be judged")


def test_the_evaluator_writes_its_json_and_warns_of_overconfidence(nodes: Set) -> None:
    for name, error_m in (("judge", 1.0), ("doubter", 3.0)):
        publish_judged(nodes, name, error_m)
        process, overconfident = nodes.processes[name], name == "doubter"
        status = nodes.diagnostics.status(name)
        assert (status.level, status.message) == ((b"\x01", "overconfident") if overconfident else (b"\x00", "ok"))
        assert process.stop(signal.SIGTERM if overconfident else signal.SIGINT) == 0
        assert ("is overconfident" in process.output()) == overconfident
        result = json.loads((nodes.folder / f"{name}.json").read_text())
        assert (result["times"], result["missed"], result["false"], result["unjudged"]) == (30, 0, 0, 0)
        assert result["targets"]["1"]["track_ids"] == [5]
        assert result["all"]["anees"] == pytest.approx(error_m**2, rel=1e-9)
        assert result["all"]["verdict"] == ("overconfident" if overconfident else "consistent")
        assert result["all"]["position_rmse_m"] == pytest.approx(error_m * 2**0.5, rel=1e-9)


# ---- a tracker dies ----------------------------------------------------------------------------------------------

RATE = 10.0  # scenario steps, of 1 s each, a second
MAX_COAST_S = 15.0
CENTRE = {
    "use_sim_time": True,
    "axes": list(AXES),
    "state_fusion": "covariance_intersection",
    "process_noise": 5.0,
    "trigger": "all_sources",
    "fusion_timeout_s": 2.5,
    "source_timeout_s": 5.0,
    "max_scan_age_s": 1.5,
    "max_coast_s": MAX_COAST_S,
    "max_delay_s": 60.0,
    "max_future_s": 30.0,
    "gate_probability": 0.999999,
    "expected_subscribers": 1,
}


def test_a_killed_tracker_is_reported_its_tracks_coast_and_it_may_come_back(ros_context: Any) -> None:
    """One tracker is killed, the other carries on. Then the other: the track coasts and is deleted. Both come back."""
    with ExitStack() as stack:
        probe = stack.enter_context(Probe(ros_context))

        def tracker(sensor: str) -> NodeProcess:
            params = {"use_sim_time": True, "axes": list(AXES), "process_noise": 5.0, "max_future_s": 30.0}
            remaps = {"~/detections": f"/replay/{sensor}/detections"}
            return stack.enter_context(NodeProcess("sensor_tracker", node=sensor, params=params, remaps=remaps))

        fused = probe.listen("/fusion_centre/tracks", PointCloud2)
        diagnostics = Diagnostics(probe)
        inputs = {f"~/sources/{s}/tracks": f"/{s}/tracks" for s in ("sensor_1", "sensor_2")}
        centre = stack.enter_context(NodeProcess("fusion_centre", params=CENTRE, remaps=inputs))
        first, second = tracker("sensor_1"), tracker("sensor_2")
        replayed = {"pace": "realtime", "rate": RATE, "steps": 100_000}
        stack.enter_context(NodeProcess("replay", params=replayed))

        def newest(source: int, status: int) -> bool:
            if not fused or fused[-1].width != 1:
                return False
            arrays = read(fused[-1])
            return (arrays.source[0], arrays.status[0]) == (source, status)

        def reported(*silent: str) -> bool:
            status = diagnostics.status("fusion_centre")
            said = "" if status is None else status.message
            return all((f"{s} is silent" in said) == (s in silent) for s in ("sensor_1", "sensor_2"))

        probe.wait_for(lambda: newest(3, 1), START_S, "a track of both sensors")
        probe.wait_for(reported, STEP_S, "no report of silence")
        second.kill()
        probe.wait_for(lambda: newest(1, 1), STEP_S, "a track of sensor_1 alone")
        probe.wait_for(lambda: reported("sensor_2"), STEP_S, "a report of sensor_2")
        first.kill()
        probe.wait_for(lambda: fused[-1].width == 0, STEP_S, "the deletion")
        check_coasting(fused)
        deleted = read(fused[-2]).track_id[0]
        probe.wait_for(lambda: reported("sensor_1", "sensor_2"), STEP_S, "a report of both")
        tracker("sensor_1"), tracker("sensor_2")
        probe.wait_for(lambda: newest(3, 1), START_S, "a track of both sensors again")
        assert read(fused[-1]).track_id[0] > deleted  # an identifier is never used again
        probe.wait_for(reported, STEP_S, "no report of silence any more")
        assert diagnostics.values("fusion_centre")["active"] == "True"
        assert centre.stop() == 0


def check_coasting(fused: list[Any]) -> None:
    """The last table is the first empty one; before it the track coasted, growing, as long as it may."""
    assert fused[-2].width == 1
    coasted = [m.width == 1 and read(m).status[0] == 3 for m in fused[:-1]]
    supported = max(k for k, c in enumerate(coasted) if not c)
    tail = fused[supported:-1]
    assert len(tail) >= 3
    assert len({int(read(m).track_id[0]) for m in tail}) == 1
    for_ns = [stamp_ns(m) - stamp_ns(fused[supported]) for m in fused[supported:]]
    assert for_ns == sorted(for_ns)
    assert for_ns[-2] <= MAX_COAST_S * SECOND_NS < for_ns[-1]
    assert all(np.diff([np.linalg.det(read(m).cov[0, 0]) for m in tail]) > 0)
