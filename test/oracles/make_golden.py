"""Make the golden bags and the fused tracks expected from them.

    PYTHONPATH=test python -m oracles.make_golden [directory, else test/data/golden]

This is an oracle. It shares no code with the package: the scene is drawn and tracked here by plain loops, and fused by
oracles/fusion_centre.py. It writes

    tracks/, odometry/       rosbag2 directories (mcap): the same tracks as track tables and as nav_msgs/Odometry
    expected_<rule>.json     the fused tables expected from tracks/ with state_fusion = <rule>
    expected_odometry.json   the same from odometry/, covariance intersection on block-diagonal covariances

The scene: targets A and B cross; C is born, B dies; tracker 2 loses two scans in a row while A and B are close. The
first scans, at 1000 s, are empty; Odometry cannot carry an empty scan, so that bag begins a step later.
"""

import json
import math
import shutil
import struct
import sys
from pathlib import Path

import numpy as np
from oracles.fusion_centre import (
    COASTED,
    CONFIRMED,
    Settings,
    arithmetic_average,
    covariance_intersection,
    motion,
    naive,
    predict,
    run_centre,
)
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

GOLDEN = Path(__file__).parents[1] / "data" / "golden"
SEED = 66
START_NS, PERIOD_NS, STEPS = 1000 * 10**9, 10**8, 60
LOST = (28, 29)  # steps at which sensor_2 publishes nothing
CROSSING = 27  # the step near which A and B meet
DEATH = 44  # the first step without B
PARAMETERS = {
    "sources": ["sensor_1", "sensor_2"], "layout": ["x", "y", "vx", "vy"], "trigger": "all_sources",
    "max_scan_age_s": 0.15, "gate_probability": 0.99, "confirmation_threshold": [2, 3],
    "deletion_threshold": [4, 5], "max_coast_s": 2.0,
    "noise_form": "piecewise_constant", "process_noise": 2.0, "out_of_sequence": "predict",
    "publish_tentative": False, "fuse_confirmed_only": True, "fuse_coasted": True,
    "covariance_intersection.criterion": "det", "arithmetic_average.criterion": "uniform",
}  # fmt: skip
SETTINGS = Settings(**{k: v for k, v in PARAMETERS.items() if k in Settings.__dataclass_fields__})
AXES = PARAMETERS["layout"]
START_STATE = {"A": [20.0, 42.0, 8.0, 1.0], "B": [20.0, 48.0, 8.0, -1.0], "C": [95.0, 25.0, -4.0, 5.0]}
# Each tracker is sharp in a direction of its own, so that covariance intersection has to weigh them.
# The centre numbers tracks by sensor_1's rows, which come first; sensor_2 lists its own in another order.
SENSORS = {
    "sensor_1": {"sigmas": (0.6, 2.0), "angle": 0.5, "ids": {"A": 11, "B": 12, "C": 13}, "first_of_c": 36},
    "sensor_2": {"sigmas": (0.9, 2.5), "angle": 1.9, "ids": {"C": 209, "B": 203, "A": 205}, "first_of_c": 37},
}
FUSED_ID = {"A": 1, "B": 2, "C": 3}
FRAME = "map"


# ---- the scene and the two trackers ------------------------------------------------------------------------------


def make_truth(rng):
    """{target: {step: state}}, each with random accelerations constant over a step."""
    dt, truth = PERIOD_NS / 1e9, {}
    transition, _ = motion(dt, SETTINGS.process_noise)
    for target, start in START_STATE.items():
        first, last = (36, STEPS) if target == "C" else (1, DEATH if target == "B" else STEPS)
        state, truth[target] = np.array(start), {}
        for step in range(first, last):
            truth[target][step] = state
            acceleration = SETTINGS.process_noise * rng.standard_normal(2)
            state = transition @ state + np.concatenate([acceleration * dt**2 / 2, acceleration * dt])
    return truth


def run_tracker(rng, truth, sensor):
    """The scans [(stamp_ns, rows)] of one tracker: a Kalman filter a target, told which measurement is its own."""
    c, s = math.cos(sensor["angle"]), math.sin(sensor["angle"])
    turn = np.array([[c, -s], [s, c]])
    noise = turn @ np.diag(np.square(sensor["sigmas"])) @ turn.T
    h, filters, scans = np.eye(2, 4), {}, []
    for step in range(STEPS):
        rows = []
        for target, track_id in sensor["ids"].items():
            if step not in truth[target] or (target == "C" and step < sensor["first_of_c"]):
                continue
            z = h @ truth[target][step] + np.linalg.cholesky(noise) @ rng.standard_normal(2)
            if target not in filters:
                mean, cov = np.concatenate([z, [0.0, 0.0]]), np.diag([0.0, 0.0, 100.0, 100.0])
                cov[:2, :2] = noise
            else:
                mean, cov = predict(*filters[target], 0, PERIOD_NS, SETTINGS.process_noise)
                gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + noise)
                joseph = np.eye(4) - gain @ h
                mean, cov = mean + gain @ (z - h @ mean), joseph @ cov @ joseph.T + gain @ noise @ gain.T
            cov = (cov + cov.T) / 2
            filters[target] = mean, cov
            rows.append({"track_id": track_id, "mean": mean, "cov": cov})
        scans.append((START_NS + step * PERIOD_NS, rows))
    return scans


# ---- the bags ----------------------------------------------------------------------------------------------------

STORE = get_typestore(Stores.ROS2_JAZZY)


def msg(type_name, /, *args, **values):
    return STORE.types[type_name.replace("/", "/msg/")](*args, **values)


def header(stamp_ns):
    return msg("std_msgs/Header", msg("builtin_interfaces/Time", *divmod(stamp_ns, 10**9)), frame_id=FRAME)


UPPER = [(i, j) for i in range(4) for j in range(i, 4)]
COLUMNS = (  # name, PointField datatype (2 UINT8, 6 UINT32, 8 FLOAT64), struct code
    [("track_id", 6, "I"), ("status", 2, "B"), ("source", 6, "I")]
    + [(name, 8, "d") for name in ("existence", "dof", "weight", *AXES)]
    + [(f"cov_{AXES[i]}_{AXES[j]}", 8, "d") for i, j in UPPER]
)
ROW = struct.Struct("<" + "".join(code for _, _, code in COLUMNS))


def track_table(stamp_ns, rows):
    fields, offset = [], 0
    for name, datatype, code in COLUMNS:
        fields.append(msg("sensor_msgs/PointField", name=name, offset=offset, datatype=datatype, count=1))
        offset += struct.calcsize(code)
    data = b""
    for row in rows:
        upper = [row["cov"][i, j] for i, j in UPPER]
        data += ROW.pack(row["track_id"], CONFIRMED, 0, 1.0, math.inf, 1.0, *row["mean"], *upper)
    shape = {"height": 1, "width": len(rows), "point_step": ROW.size, "row_step": len(data)}
    content = {"fields": fields, "data": np.frombuffer(data, np.uint8), "is_bigendian": False, "is_dense": True}
    return msg("sensor_msgs/PointCloud2", header=header(stamp_ns), **shape, **content)


def odometry(stamp_ns, row):
    x, y, vx, vy = row["mean"]
    pose_cov, twist_cov = np.zeros((6, 6)), np.zeros((6, 6))
    pose_cov[:2, :2], twist_cov[:2, :2] = row["cov"][:2, :2], row["cov"][2:, 2:]
    identity = msg("geometry_msgs/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    pose = msg("geometry_msgs/Pose", msg("geometry_msgs/Point", x, y, 0.0), identity)
    twist = msg("geometry_msgs/Twist", *(msg("geometry_msgs/Vector3", a, b, 0.0) for a, b in ((vx, vy), (0.0, 0.0))))
    pose = msg("geometry_msgs/PoseWithCovariance", pose, pose_cov.ravel())
    twist = msg("geometry_msgs/TwistWithCovariance", twist, twist_cov.ravel())
    return msg("nav_msgs/Odometry", header(stamp_ns), str(row["track_id"]), pose, twist)


def write_bag(directory, scans, topic, message_type, to_messages):
    """Received 1 ms (sensor_1) and 5 ms (sensor_2) after the stamp, the messages of one scan 10 us apart."""
    shutil.rmtree(directory, ignore_errors=True)
    received = []
    with Writer(directory, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        for source, offset_ns in (("sensor_1", 10**6), ("sensor_2", 5 * 10**6)):
            connection = bag.add_connection(f"/{source}/{topic}", message_type, typestore=STORE)
            for stamp_ns, rows in scans[source]:
                for i, message in enumerate(to_messages(stamp_ns, rows)):
                    raw = STORE.serialize_cdr(message, message_type)
                    received.append((stamp_ns + offset_ns + i * 10**4, connection, raw))
        for time_ns, connection, raw in sorted(received, key=lambda item: item[0]):
            bag.write(connection, time_ns, raw)


def check_bag(directory, scans):
    """What comes out of the bag of track tables is, to the last bit, what the oracle works on."""
    waiting = {f"/{source}/tracks": list(of_source) for source, of_source in scans.items()}
    with Reader(directory) as bag:
        for connection, time_ns, raw in bag.messages():
            message = STORE.deserialize_cdr(raw, connection.msgtype)
            stamp_ns, rows = waiting[connection.topic].pop(0)
            assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp_ns < time_ns
            for row, values in zip(rows, ROW.iter_unpack(message.data.tobytes()), strict=True):
                assert (values[0], *values[6:10]) == (row["track_id"], *row["mean"])
                assert all(row["cov"][j, i] == v for (i, j), v in zip(UPPER, values[10:], strict=True))
    assert not any(waiting.values())


# ---- what the scene must have in it ------------------------------------------------------------------------------


def check(name, steps, log, margins, truth):
    target_of = {(s, i): target for s, sensor in SENSORS.items() for target, i in sensor["ids"].items()}
    close, by_step = 0, {}
    for entry, step in zip(log, steps, strict=True):
        k = (step["stamp_ns"] - START_NS) // PERIOD_NS
        by_step[k] = {row["track_id"]: row for row in step["tracks"]}
        for member, track_id in entry["members"].items():
            assert FUSED_ID[target_of[member]] == track_id, "an identity switched"
        crossed = {(target_of[s, i], j) for s, i, j in entry["candidates"] if FUSED_ID[target_of[s, i]] != j}
        close += abs(k - CROSSING) <= 10 and crossed >= {("A", 2), ("B", 1)}
    assert close >= 3, f"A and B are in each other's gate for {close} steps only"
    gap = {k: truth["A"][k][:2] - truth["B"][k][:2] for k in truth["B"]}
    assert gap[CROSSING - 15][1] < -2 and gap[CROSSING + 15][1] > 2 and np.hypot(*gap[CROSSING]) < 1  # noqa: PT018
    first, after = {1: 2, 2: 2, 3: 37}, {1: STEPS, 2: DEATH + 3, 3: STEPS}  # two hits confirm, the fourth miss deletes
    for k, rows in by_step.items():
        assert list(rows) == [i for i in (1, 2, 3) if first[i] <= k < after[i]], (k, list(rows))
        for track_id, row in rows.items():
            dead = track_id == 2 and k >= DEATH
            bits = 0 if dead else 1 if k == LOST[1] else 3
            assert (row["source"], row["status"]) == (bits, CONFIRMED + COASTED * dead), (k, row)
            assert np.linalg.eigvalsh(row["cov"]).min() > 1e-3, "a covariance is not positive definite"
            errors = {target: np.array(row["mean"]) - states[k] for target, states in truth.items() if k in states}
            d2 = {target: e @ np.linalg.inv(row["cov"]) @ e for target, e in errors.items()}
            assert dead or FUSED_ID[min(d2, key=d2.get)] == track_id, "a fused track is nearer to another target"
    least = {key: min(values) for key, values in margins.items()}
    assert min(least.values()) > 1e-6, "a decision hangs on rounding"
    print(f"{name}: {len(steps)} steps, {close} of them crossing in each other's gate, least margins {least}")


def main(directory):
    rng = np.random.default_rng(SEED)
    truth = make_truth(rng)
    scans = {source: run_tracker(rng, truth, sensor) for source, sensor in SENSORS.items()}
    scans["sensor_2"] = [scan for k, scan in enumerate(scans["sensor_2"]) if k not in LOST]
    directory.mkdir(parents=True, exist_ok=True)
    tables, odometries = (lambda t, rows: [track_table(t, rows)]), (lambda t, rows: [odometry(t, row) for row in rows])
    write_bag(directory / "tracks", scans, "tracks", "sensor_msgs/msg/PointCloud2", tables)
    write_bag(directory / "odometry", scans, "odometry", "nav_msgs/msg/Odometry", odometries)
    check_bag(directory / "tracks", scans)

    block = np.kron(np.eye(2), np.ones((2, 2)))
    blocks = {
        source: [(t, [row | {"cov": row["cov"] * block} for row in rows]) for t, rows in of_source if rows]
        for source, of_source in scans.items()
    }
    jobs = [("tracks", rule.__name__, rule, scans) for rule in (covariance_intersection, naive, arithmetic_average)]
    for bag, name, rule, tracks in [*jobs, ("odometry", "odometry", covariance_intersection, blocks)]:
        steps, log, margins = run_centre(tracks, rule, SETTINGS)
        check(name, steps, log, margins, truth)
        head = {"bag": bag, "frame_id": FRAME, "parameters": PARAMETERS | {"state_fusion": rule.__name__}}
        lines = ",\n".join(json.dumps(step, separators=(",", ":")) for step in steps)
        (directory / f"expected_{name}.json").write_text(json.dumps(head)[:-1] + f', "steps": [\n{lines}\n]}}\n')


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else GOLDEN)
