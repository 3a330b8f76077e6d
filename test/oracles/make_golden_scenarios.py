"""Make the golden bags of two scenarios and the fused tracks expected from them.

    PYTHONPATH=test python -m oracles.make_golden_scenarios [directory, else test/data/golden]

This is an oracle, as make_golden.py: it shares no code with the package. It writes, for each of
the scenes "turn" (li2022-nonlinear, range and bearing) and "line" (li2022-linear, positions)

    <scene>/                        a rosbag2 directory (mcap) of detections of two sensors
    expected_<scene>_<rule>.json    the fused tables expected with state_fusion = <rule>

The scenes are those of Li et al., AA density fusion, IV: one target, one cubature Kalman filter a sensor by plain loops
(of linear functions it is the Kalman filter), fused after each scan, the fused posterior fed back to both. Sensor 2
misses the target twice in a row; once sensor 1 reports a second detection far away, and once a bearing of sensor 1 is
given a turn too much.
"""

import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from oracles.fusion_centre import covariance_intersection, naive
from oracles.make_golden import GOLDEN, header, msg, write_bag

STEPS, SECOND_NS = 60, 10**9
MISSED, DOUBLED, TURNED = (20, 21), 33, 40  # steps: of sensor_2 without, of sensor_1 with two detections, a turn more


class Scene(NamedTuple):
    """What a scenario is made of; sensors by name: place and standard deviations."""

    seed: int
    mean: list[float]
    cov: list[float]
    sensors: dict[str, Any]
    axes: tuple[str, str]
    advance: Callable[..., Any]
    root: Any  # of the process noise
    observe: Callable[..., Any]
    far: tuple[float, float]  # from the target to the second detection


def glide(state):
    x, y, vx, vy = state
    return np.array([x + vx, y + vy, vx, vy])


def acceleration_root(sigma):
    """One second of an acceleration that is constant meanwhile, the same law on each axis: root of its covariance."""
    return sigma * np.array([[0.5, 0.0], [0.0, 0.5], [1.0, 0.0], [0.0, 1.0]])


def position(state, place):
    return np.array([state[0] - place[0], state[1] - place[1]])


def advance(state):
    x, y, vx, vy, w = state
    assert abs(w) > 1e-6, "the turn rate's limit is not spelt out here"
    s, c = math.sin(w), math.cos(w)
    along, across = s / w, (1 - c) / w
    return np.array([x + along * vx - across * vy, y + across * vx + along * vy, c * vx - s * vy, s * vx + c * vy, w])


def turning_root(q, turn_q):
    """One second of white acceleration on each axis, and of white turn acceleration: root of their covariance."""
    noise = np.zeros((5, 5))
    for position, velocity in ((0, 2), (1, 3)):
        noise[position, position], noise[velocity, velocity] = q / 3, q
        noise[position, velocity] = noise[velocity, position] = q / 2
    noise[4, 4] = turn_q
    return np.linalg.cholesky(noise)


def polar(state, place):
    dx, dy = state[0] - place[0], state[1] - place[1]
    return np.array([math.sqrt(dx * dx + dy * dy), math.atan2(dy, dx)])


def wrapped(residual, scene):
    """Bring a bearing to half a turn."""
    if scene.axes[1] != "bearing":
        return residual
    return np.array([residual[0], math.remainder(residual[1], 2 * math.pi)])


LINE = Scene(
    seed=7, mean=[1000.0, 1000.0, 20.0, 0.0], cov=[500.0, 500.0, 50.0, 50.0],
    sensors={"sensor_1": ((0.0, 0.0), (20.0, 20.0)), "sensor_2": ((0.0, 0.0), (40.0, 40.0))}, axes=("x", "y"),
    advance=glide, root=acceleration_root(5.0), observe=position, far=(400.0, 300.0),
)  # fmt: skip
TURN = Scene(
    seed=99, mean=[1000.0, 1000.0, 20.0, 0.0, -math.pi / 60], cov=[500.0, 500.0, 50.0, 50.0, 0.01],
    sensors={"sensor_1": ((0.0, 0.0), (10.0, math.pi / 180)), "sensor_2": ((500.0, 0.0), (20.0, math.pi / 90))},
    axes=("range", "bearing"), advance=advance, root=turning_root(0.1, 1e-4), observe=polar, far=(400.0, 0.3),
)  # fmt: skip


def cubature(mean, cov):
    root, n = np.linalg.cholesky(cov), len(mean)
    return [mean + sign * math.sqrt(n) * root[:, i] for sign in (1, -1) for i in range(n)]


def predict(mean, cov, scene):
    points = [scene.advance(p) for p in cubature(mean, cov)]
    mean = sum(points) / len(points)
    return mean, sum(np.outer(p - mean, p - mean) for p in points) / len(points) + scene.root @ scene.root.T


def joint(mean, cov, sensor, scene):
    """Expected measurement, its covariance, and that with the state."""
    place, sigmas = sensor
    points, centre = cubature(mean, cov), scene.observe(mean, place)
    offsets = [wrapped(scene.observe(p, place) - centre, scene) for p in points]
    shift = sum(offsets) / len(points)
    deviations = [o - shift for o in offsets]
    spread = sum(np.outer(d, d) for d in deviations) / len(points) + np.diag(np.square(sigmas))
    cross = sum(np.outer(p - mean, d) for p, d in zip(points, deviations, strict=True)) / len(points)
    return centre + shift, spread, cross


def update(mean, cov, z, sensor, scene):
    expected, spread, cross = joint(mean, cov, sensor, scene)
    gain = cross @ np.linalg.inv(spread)
    cov = cov - gain @ spread @ gain.T
    return mean + gain @ wrapped(z - expected, scene), (cov + cov.T) / 2


def arithmetic_average(members):
    """Weights by eq. (40): log det P(w) - w log det P1 - (1 - w) log det P2 is concave, its slope bisected."""
    (m1, p1), (m2, p2) = members
    gap = np.outer(m1 - m2, m1 - m2)
    target = np.linalg.slogdet(p1)[1] - np.linalg.slogdet(p2)[1]

    def merged(w):
        return w * p1 + (1 - w) * p2 + w * (1 - w) * gap

    def slope(w):
        return np.trace(np.linalg.inv(merged(w)) @ (p1 - p2 + (1 - 2 * w) * gap)) - target

    low, high = 0.0, 1.0
    assert slope(low) > 0 > slope(high), "the optimum is meant to be inside"
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if slope(middle) > 0 else (low, middle)
    return low * m1 + (1 - low) * m2, merged(low)


def make_scans(scene):
    """{sensor: [detections of step 1, 2, ...]}."""
    rng, state = np.random.default_rng(scene.seed), np.array(scene.mean)
    scans = {name: [] for name in scene.sensors}
    for step in range(1, STEPS + 1):
        state = scene.advance(state) + scene.root @ rng.standard_normal(scene.root.shape[1])
        for name, (place, sigmas) in scene.sensors.items():
            z = wrapped(scene.observe(state, place) + np.array(sigmas) * rng.standard_normal(2), scene)
            detections = [] if name == "sensor_2" and step in MISSED else [z]
            if name == "sensor_1" and step == DOUBLED:
                detections.insert(0, z + scene.far)
            if name == "sensor_1" and step == TURNED and scene.axes[1] == "bearing":
                detections = [z - [0.0, 2 * math.pi]]
            scans[name].append(detections)
    return scans


def fused_steps(scene, scans, rule):
    mean, cov, steps = np.array(scene.mean), np.diag(scene.cov), []
    for step in range(1, STEPS + 1):
        mean, cov = predict(mean, cov, scene)
        members = []
        for name, sensor in scene.sensors.items():
            expected, spread, _ = joint(mean, cov, sensor, scene)
            detections = scans[name][step - 1]
            residuals = [wrapped(z - expected, scene) for z in detections]
            order = sorted(range(len(residuals)), key=lambda i: residuals[i] @ np.linalg.inv(spread) @ residuals[i])
            members.append(update(mean, cov, detections[order[0]], sensor, scene) if order else (mean, cov))
        mean, cov = rule(members)
        assert np.linalg.eigvalsh(cov).min() > 1e-7
        row = {"track_id": 1, "source": 3, "status": 1, "mean": mean.tolist(), "cov": cov.tolist()}
        steps.append({"stamp_ns": step * SECOND_NS, "tracks": [row]})
    return steps


def detection_table(stamp_ns, rows, axes):
    a, b = axes
    names = (a, b, f"cov_{a}_{a}", f"cov_{a}_{b}", f"cov_{b}_{b}")
    fields = [msg("sensor_msgs/PointField", name=n, offset=8 * i, datatype=8, count=1) for i, n in enumerate(names)]
    data = np.array(rows, "<f8").reshape(len(rows), len(names))
    shape = {"height": 1, "width": len(rows), "point_step": 8 * len(names), "row_step": data.nbytes}
    content = {"fields": fields, "data": data.view(np.uint8).reshape(-1), "is_bigendian": False, "is_dense": True}
    return msg("sensor_msgs/PointCloud2", header=header(stamp_ns), **shape, **content)


def make(directory, name, scene, rules):
    scans = make_scans(scene)
    stamped = {
        sensor: [
            (step * SECOND_NS, [[*z, sigmas[0] ** 2, 0.0, sigmas[1] ** 2] for z in detections])
            for step, detections in enumerate(scans[sensor], start=1)
        ]
        for sensor, (_, sigmas) in scene.sensors.items()
    }
    table = lambda stamp_ns, rows: [detection_table(stamp_ns, rows, scene.axes)]  # noqa: E731
    write_bag(directory / name, stamped, "detections", "sensor_msgs/msg/PointCloud2", table)
    for rule in rules:
        steps = fused_steps(scene, scans, rule)
        lines = ",\n".join(json.dumps(step, separators=(",", ":")) for step in steps)
        path = directory / f"expected_{name}_{rule.__name__}.json"
        path.write_text(f'{{"bag": "{name}", "steps": [\n{lines}\n]}}\n')
        print(f"{path.name}: {len(steps)} steps, ends at {np.round(steps[-1]['tracks'][0]['mean'], 2)}")


def main(directory):
    directory.mkdir(parents=True, exist_ok=True)
    make(directory, "turn", TURN, (arithmetic_average, covariance_intersection))
    make(directory, "line", LINE, (arithmetic_average, naive))


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else GOLDEN)
