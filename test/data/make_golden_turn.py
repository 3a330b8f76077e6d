"""Make the golden bag of li2022-nonlinear and the fused tracks expected from it: python test/data/make_golden_turn.py.

This is an oracle, as make_golden.py: it shares no code with the package. It writes into the directory given (else
test/data/golden)

    turn/                        a rosbag2 directory (mcap) of detections, range and bearing, of two sensors
    expected_turn_<rule>.json    the fused tables expected with state_fusion = <rule>

The scene is Li et al., AA density fusion, IV-B: a turning target, one cubature Kalman filter a sensor by plain loops,
fused after each scan, the fused posterior fed back to both. Sensor 2 misses the target twice in a row; once sensor 1
reports a second detection far away, and once its bearing is given a turn too much.
"""

import json
import math
import sys
from pathlib import Path

import numpy as np
from make_golden import covariance_intersection, header, msg, write_bag

SEED, STEPS, SECOND_NS = 99, 60, 10**9
MISSED, DOUBLED, TURNED = (20, 21), 33, 40  # steps: of sensor_2 without, of sensor_1 with two detections, a turn more
Q, TURN_Q = 0.1, 1e-4
MEAN, COV = [1000.0, 1000.0, 20.0, 0.0, -math.pi / 60], [500.0, 500.0, 50.0, 50.0, 0.01]
SENSORS = {  # place, standard deviations of range and bearing
    "sensor_1": ((0.0, 0.0), (10.0, math.pi / 180)),
    "sensor_2": ((500.0, 0.0), (20.0, math.pi / 90)),
}
NAMES = ("range", "bearing", "cov_range_range", "cov_range_bearing", "cov_bearing_bearing")


def advance(state):
    x, y, vx, vy, w = state
    assert abs(w) > 1e-6, "the turn rate's limit is not spelt out here"
    s, c = math.sin(w), math.cos(w)
    along, across = s / w, (1 - c) / w
    return np.array([x + along * vx - across * vy, y + across * vx + along * vy, c * vx - s * vy, s * vx + c * vy, w])


def process_noise():
    """One second of white acceleration on each axis, and of white turn acceleration."""
    noise = np.zeros((5, 5))
    for position, velocity in ((0, 2), (1, 3)):
        noise[position, position], noise[velocity, velocity] = Q / 3, Q
        noise[position, velocity] = noise[velocity, position] = Q / 2
    noise[4, 4] = TURN_Q
    return noise


def observe(state, place):
    dx, dy = state[0] - place[0], state[1] - place[1]
    return np.array([math.sqrt(dx * dx + dy * dy), math.atan2(dy, dx)])


def wrapped(residual):
    return np.array([residual[0], math.remainder(residual[1], 2 * math.pi)])


def cubature(mean, cov):
    root, n = np.linalg.cholesky(cov), len(mean)
    return [mean + sign * math.sqrt(n) * root[:, i] for sign in (1, -1) for i in range(n)]


def predict(mean, cov):
    points = [advance(p) for p in cubature(mean, cov)]
    mean = sum(points) / len(points)
    return mean, sum(np.outer(p - mean, p - mean) for p in points) / len(points) + process_noise()


def joint(mean, cov, sensor):
    """Expected measurement, its covariance, and that with the state."""
    place, sigmas = sensor
    points, centre = cubature(mean, cov), observe(mean, place)
    offsets = [wrapped(observe(p, place) - centre) for p in points]
    shift = sum(offsets) / len(points)
    deviations = [o - shift for o in offsets]
    spread = sum(np.outer(d, d) for d in deviations) / len(points) + np.diag(np.square(sigmas))
    cross = sum(np.outer(p - mean, d) for p, d in zip(points, deviations, strict=True)) / len(points)
    return centre + shift, spread, cross


def update(mean, cov, z, sensor):
    expected, spread, cross = joint(mean, cov, sensor)
    gain = cross @ np.linalg.inv(spread)
    cov = cov - gain @ spread @ gain.T
    return mean + gain @ wrapped(z - expected), (cov + cov.T) / 2


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


def make_scans(rng):
    """{sensor: [detections of step 1, 2, ...]}."""
    state, root = np.array(MEAN), np.linalg.cholesky(process_noise())
    scans = {name: [] for name in SENSORS}
    for step in range(1, STEPS + 1):
        state = advance(state) + root @ rng.standard_normal(5)
        for name, (place, sigmas) in SENSORS.items():
            z = wrapped(observe(state, place) + np.array(sigmas) * rng.standard_normal(2))
            found = [] if name == "sensor_2" and step in MISSED else [z]
            if name == "sensor_1" and step == DOUBLED:
                found.insert(0, z + [400.0, 0.3])
            if name == "sensor_1" and step == TURNED:
                found = [z - [0.0, 2 * math.pi]]
            scans[name].append(found)
    return scans


def fused_steps(scans, rule):
    mean, cov, steps = np.array(MEAN), np.diag(COV), []
    for step in range(1, STEPS + 1):
        mean, cov = predict(mean, cov)
        members = []
        for name, sensor in SENSORS.items():
            expected, spread, _ = joint(mean, cov, sensor)
            residuals = [wrapped(z - expected) for z in scans[name][step - 1]]
            order = sorted(range(len(residuals)), key=lambda i: residuals[i] @ np.linalg.inv(spread) @ residuals[i])
            members.append(update(mean, cov, scans[name][step - 1][order[0]], sensor) if order else (mean, cov))
        mean, cov = rule(members)
        assert np.linalg.eigvalsh(cov).min() > 1e-7
        row = {"track_id": 1, "source": 3, "status": 1, "mean": mean.tolist(), "cov": cov.tolist()}
        steps.append({"stamp_ns": step * SECOND_NS, "tracks": [row]})
    return steps


def detection_table(stamp_ns, rows):
    fields = [msg("sensor_msgs/PointField", name=n, offset=8 * i, datatype=8, count=1) for i, n in enumerate(NAMES)]
    data = np.array(rows, "<f8").reshape(len(rows), len(NAMES))
    shape = {"height": 1, "width": len(rows), "point_step": 8 * len(NAMES), "row_step": data.nbytes}
    content = {"fields": fields, "data": data.view(np.uint8).reshape(-1), "is_bigendian": False, "is_dense": True}
    return msg("sensor_msgs/PointCloud2", header=header(stamp_ns), **shape, **content)


def main():
    directory = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "golden"
    directory.mkdir(parents=True, exist_ok=True)
    scans = make_scans(np.random.default_rng(SEED))
    stamped = {
        name: [
            (step * SECOND_NS, [[*z, SENSORS[name][1][0] ** 2, 0.0, SENSORS[name][1][1] ** 2] for z in found])
            for step, found in enumerate(of_sensor, start=1)
        ]
        for name, of_sensor in scans.items()
    }
    table = lambda stamp_ns, rows: [detection_table(stamp_ns, rows)]  # noqa: E731
    write_bag(directory / "turn", stamped, "detections", "sensor_msgs/msg/PointCloud2", table)
    for rule in (arithmetic_average, covariance_intersection):
        steps = fused_steps(scans, rule)
        lines = ",\n".join(json.dumps(step, separators=(",", ":")) for step in steps)
        path = directory / f"expected_turn_{rule.__name__}.json"
        path.write_text(f'{{"bag": "turn", "steps": [\n{lines}\n]}}\n')
        print(f"{path.name}: {len(steps)} steps, ends at {np.round(steps[-1]['tracks'][0]['mean'], 2)}")


if __name__ == "__main__":
    main()
