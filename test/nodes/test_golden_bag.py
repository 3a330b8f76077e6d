"""The golden bags through real nodes against oracles that share no code with the package (test/oracles/).

One replay process plays the bag of track tables to three centres, one a rule; another one that of Odometry, on a clock
of its own. What is published is recorded in both storage formats, and both recordings are played again.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from nodes.support import AXES, PATIENT, START_S, STEP_S, clock, deep, read, stamp_ns
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message
from ros_helpers import NodeProcess, Probe
from rosbags.rosbag2 import Reader
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from msg_adapters.odometry import odometry_from_msg
from msg_adapters.track_table import track_table_to_msg
from track_fusion.centre.centre import FusionCentre
from track_fusion.centre.config import (
    CentreConfig,
    FusionCentreParams,
    IdentityParams,
    ScanBufferParams,
    SourceConfig,
    TrackManagerParams,
)
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.nodes.recorder import Recorder
from track_fusion.params import specs
from track_fusion.rules import RULES as FUSION_RULES
from track_fusion.tracks import StateLayout, TrackBatch

ROOT = Path(__file__).resolve().parents[2]
GOLDEN = ROOT / "test" / "data" / "golden"
RULES = ("naive", "covariance_intersection", "arithmetic_average")
SOURCES = ("sensor_1", "sensor_2")
RATE = 10.0  # bag seconds a second: 6 s of bag
TOLERANCE = 1e-9  # of the largest entry
MAX_BAG_BYTES = 1_000_000
#: Recording -> the rule of the centre that hears it again.
RECORDINGS = {"mcap": "covariance_intersection", "sqlite3": "arithmetic_average"}
TYPES = {"tracks": (PointCloud2, "sensor_msgs/msg/PointCloud2"), "odometry": (Odometry, "nav_msgs/msg/Odometry")}


def expected(name: str) -> dict[str, Any]:
    return json.loads((GOLDEN / f"expected_{name}.json").read_text())


def centre(name: str, oracle: str, prefix: str, topic: str, clock_topic: str) -> NodeProcess:
    """Start a centre with the oracle's parameters on /<prefix><source>/<topic>."""
    given = expected(oracle)["parameters"]
    names = {"sources": "source_configurations", "layout": "axes"}
    own = {k: v for k, v in given.items() if "." not in k or k.startswith(f"{given['state_fusion']}.")}
    params = PATIENT | {names.get(k, k): v for k, v in own.items()}
    params["source_types"] = ["odometry" if topic == "odometry" else "track_table"] * len(SOURCES)
    inputs = {f"~/sources/{s}/tracks": f"{prefix}/{s}/{topic}" for s in SOURCES}
    params |= deep(*(f"{t}.subscription" for t in inputs.values()), f"/{name}/tracks.publisher")
    return NodeProcess("fusion_centre", node=name, params=params, remaps=inputs | {"/clock": clock_topic})


def replay(
    name: str, bag: Path, clock_topic: str, prefix: str = "", readers: int = 1, rate: float = RATE
) -> NodeProcess:
    """Start a replay of a bag."""
    params: dict[str, Any] = {"bag": str(bag), "pace": "realtime", "rate": rate, "expected_subscribers_each": readers}
    if prefix:
        params["bag_remaps"] = [f"/{s}/tracks:={prefix}/{s}/tracks" for s in SOURCES]
    return NodeProcess("replay", node=name, params=params, remaps={"/clock": clock_topic})


@pytest.fixture(scope="module")
def fused(shared_domain: int, shared_probe: Probe, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Play all bags; give the fused tables of each centre by its name."""
    probe, folder = shared_probe, tmp_path_factory.mktemp("bags")
    use_sim_time = Parameter("use_sim_time", Parameter.Type.BOOL, True)
    with ExitStack() as stack:
        recording = stack.enter_context(Probe(probe.node.context, "recorder", parameter_overrides=[use_sim_time]))
        topics = {f"/{s}/tracks": TYPES["tracks"][1] for s in SOURCES}
        recorders = {s: Recorder(recording.node, folder / s, topics, s) for s in RECORDINGS}
        probe.executor.add_node(recording.node)
        ran = {rule: stack.enter_context(centre(rule, rule, "", "tracks", "/clock")) for rule in RULES}
        ran["odometry"] = stack.enter_context(centre("odometry", "odometry", "", "odometry", "/clock_odometry"))
        for storage, rule in RECORDINGS.items():
            again = centre(storage, rule, f"/again_{storage}", "tracks", f"/clock_{storage}")
            ran[storage] = stack.enter_context(again)
        tables = {name: probe.listen(f"/{name}/tracks", PointCloud2, 1000) for name in ran}
        counts = {name: len(expected(name)["steps"]) for name in (*RULES, "odometry")}
        counts |= {storage: counts[rule] for storage, rule in RECORDINGS.items()}
        players = [
            stack.enter_context(replay("replay_tracks", GOLDEN / "tracks", "/clock", readers=len(RULES) + 2)),
            stack.enter_context(replay("replay_odometry", GOLDEN / "odometry", "/clock_odometry")),
        ]
        probe.wait_for(lambda: all(len(tables[r]) >= counts[r] for r in RULES), START_S, "the fused bag")
        finish_odometry(probe, tables["odometry"], counts["odometry"])
        assert all(r.counts == {"/sensor_1/tracks": 60, "/sensor_2/tracks": 58} for r in recorders.values())
        for storage, recorder in recorders.items():
            recorder.close()
            again = replay(f"replay_{storage}", folder / storage, f"/clock_{storage}", f"/again_{storage}")
            players.append(stack.enter_context(again))
        probe.wait_for(lambda: all(len(tables[s]) >= counts[s] for s in RECORDINGS), START_S, "the recordings")
        assert [p.wait(STEP_S) for p in players] == [0] * len(players)
        assert {name: p.stop() for name, p in ran.items()} == dict.fromkeys(ran, 0)
        yield tables, folder


def finish_odometry(probe: Probe, tables: list[Any], count: int) -> None:
    """Let the clock pass the timeout: the last scan of Odometry has no successor that would complete it."""
    probe.wait_for(lambda: len(tables) >= count - 1, START_S, "all but the last step of the bag of Odometry")
    ticker = probe.publisher("/clock_odometry", Clock)
    late = stamp_ns(tables[-1]) + int(2e9 * PATIENT["fusion_timeout_s"])

    def ticked() -> bool:
        ticker.publish(clock(late))
        return len(tables) >= count

    probe.wait_for(ticked, STEP_S, "the last step of the bag of Odometry")


def compare(messages: list[PointCloud2], oracle: str) -> None:
    """Compare fused tables with the oracle's, step by step."""
    steps = expected(oracle)["steps"]
    assert [stamp_ns(m) for m in messages] == [s["stamp_ns"] for s in steps]
    for step, msg in zip(steps, messages, strict=True):
        got, want, at = read(msg), step["tracks"], step["stamp_ns"]
        for field in ("track_id", "source", "status"):
            assert getattr(got, field).tolist() == [t[field] for t in want], (at, field)
        assert got.weight.shape[1] == 1
        for k, track in enumerate(want):
            for fused, value in ((got.mean[k, 0], track["mean"]), (got.cov[k, 0], track["cov"])):
                np.testing.assert_allclose(fused, value, rtol=0, atol=TOLERANCE * np.abs(value).max(), err_msg=str(at))


@pytest.mark.parametrize("name", [*RULES, "odometry"])
def test_a_golden_bag_gives_the_expected_tracks(name: str, fused: Any) -> None:
    compare(fused[0][name], name)


@pytest.mark.parametrize("storage", RECORDINGS)
def test_a_recording_replayed_gives_the_same_to_the_last_bit(storage: str, fused: Any) -> None:
    tables, folder = fused
    assert sorted(p.suffix for p in (folder / storage).iterdir())[0] == {"mcap": ".mcap", "sqlite3": ".db3"}[storage]
    compare(tables[storage], RECORDINGS[storage])
    first, again = ([m.data.tobytes() for m in tables[name]] for name in (RECORDINGS[storage], storage))
    assert first == again


def library_centre(oracle: str) -> FusionCentre:
    """Return the library's centre with the parameters of `centre`."""
    given = PATIENT | expected(oracle)["parameters"]
    sources = tuple(SourceConfig(name, assembles=oracle == "odometry") for name in SOURCES)

    def read_as(kind: Any, prefix: str = "") -> Any:
        return kind(**{name: given[prefix + name] for name in specs(kind) if prefix + name in given})

    rule = FUSION_RULES[given["state_fusion"]]
    motion = NearlyConstantVelocity(StateLayout(tuple(given["layout"])), read_as(MotionParams))
    kinds = FusionCentreParams, TrackManagerParams, ScanBufferParams
    return FusionCentre(
        CentreConfig(
            sources,
            motion,
            "map",
            rule,
            read_as(rule.params, f"{rule.key}."),
            *map(read_as, kinds),
            identity=read_as(IdentityParams),
        )  # fmt: skip
    )


@pytest.mark.parametrize("name", [*RULES, "odometry"])
def test_a_library_user_gets_what_the_node_publishes_to_the_last_bit(name: str, fused: Any) -> None:
    """The same bag fed by hand, with the stamps for a clock, and at last a clock that runs on."""
    own, published, stamp = library_centre(name), [], 0
    with Reader(GOLDEN / ("odometry" if name == "odometry" else "tracks")) as bag:
        for connection, _, raw in bag.messages():
            msg = deserialize_message(raw, TYPES["odometry" if name == "odometry" else "tracks"][0])
            arrays = odometry_from_msg(msg, AXES).tracks if name == "odometry" else read(msg)
            fields = {field: value for field, value in vars(arrays).items() if field != "axes"}
            scan, stamp = TrackBatch.screened(layout=StateLayout(arrays.axes), **fields)[0], stamp_ns(msg)
            source = SOURCES.index(connection.topic.split("/")[1])
            assert own.receive(source, scan, stamp, stamp) is None
            published += own.advance(stamp)
    published += own.advance(stamp + int(2e9 * PATIENT["fusion_timeout_s"]))
    tables = [track_table_to_msg(result.tracks, AXES, result.time_ns).data.tobytes() for result in published]
    assert tables == [msg.data.tobytes() for msg in fused[0][name]]
    assert [result.time_ns for result in published] == [stamp_ns(msg) for msg in fused[0][name]]


def test_identities_do_not_switch(fused: Any) -> None:
    """The crossing targets keep their side of y: 1 goes up, 2 goes down, so that a switch would show as a jump."""
    for name, messages in fused[0].items():
        paths: dict[int, list[float]] = {}
        for arrays in map(read, messages):
            for track_id, mean in zip(arrays.track_id.tolist(), arrays.mean[:, 0], strict=True):
                paths.setdefault(track_id, []).append(float(mean[1]))
        assert sorted(paths) == [1, 2, 3], name
        assert paths[1][0] < paths[2][0] - 2, name
        assert paths[1][40] > paths[2][40] + 2, name
        assert max(abs(np.diff(path)).max() for path in paths.values()) < 2.5, name


#: Bag of detections, the scenario whose parameter file runs it, rule.
SCENARIOS = [
    pytest.param("turn", "li2022-nonlinear", "arithmetic_average", marks=pytest.mark.slow),
    ("turn", "li2022-nonlinear", "covariance_intersection"),
    ("line", "li2022-linear", "arithmetic_average"),
    pytest.param("line", "li2022-linear", "naive", marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("bag", "scenario", "rule"), SCENARIOS)
def test_a_bag_of_detections_gives_the_expected_tracks_through_trackers_with_feedback(
    bag: str, scenario: str, rule: str, ros_context: Any, ros_domain: int
) -> None:
    """A scenario of Li 2022 with its own parameter file: two trackers, a centre, and back."""
    file, oracle = ROOT / "config" / f"{scenario}.yaml", f"{bag}_{rule}"
    steps = len(expected(oracle)["steps"])
    patient = {"max_future_s": 1000.0, "feedback_timeout_s": 1000.0, "expected_subscribers": 1}
    criterion = {"covariance_intersection": "det", "arithmetic_average": "diversity"}.get(rule)
    criteria = {f"{rule}.criterion": criterion} if criterion else {}
    fusing = {k: v for k, v in PATIENT.items() if k not in ("axes", "use_sim_time")}
    fusing |= {"state_fusion": rule, "expected_subscribers": 3, **criteria, **deep("/fusion_centre/tracks.publisher")}
    with ExitStack() as stack:
        probe = stack.enter_context(Probe(ros_context))
        tables = probe.listen("/fusion_centre/tracks", PointCloud2, 1000)
        for sensor in SOURCES:
            params = patient | deep(f"/{sensor}/detections.subscription")
            remaps = {"~/detections": f"/{sensor}/detections", "~/feedback": "/fusion_centre/tracks"}
            tracker = NodeProcess("sensor_tracker", node=sensor, params=params, params_file=file, remaps=remaps)
            stack.enter_context(tracker)
        inputs = {f"~/sources/{s}/tracks": f"/{s}/tracks" for s in SOURCES}
        stack.enter_context(NodeProcess("fusion_centre", params=fusing, params_file=file, remaps=inputs))
        player = stack.enter_context(replay(f"replay_{bag}", GOLDEN / bag, "/clock", rate=20.0))
        probe.wait_for(lambda: len(tables) >= steps, START_S, "the fused tracks of every step")
        assert player.wait(STEP_S) == 0
    compare(tables, oracle)


def test_the_golden_bags_are_small() -> None:
    for bag in ("tracks", "odometry", "turn", "line"):
        assert sum(p.stat().st_size for p in (GOLDEN / bag).iterdir()) < MAX_BAG_BYTES
