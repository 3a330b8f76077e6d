"""Gated association of two scans against costs by a Python loop with one dense assignment; the centre's step."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.optimize import linear_sum_assignment

from benchmark.baselines import Array, association_costs_by_loop
from benchmark.measure import Result, race
from track_fusion.association.assignment import nearest_neighbour
from track_fusion.centre.centre import FusionCentre
from track_fusion.centre.config import CentreConfig, SourceConfig
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.rules import RULES
from track_fusion.solvers.chi_square import chi_square_quantile
from track_fusion.tracks import TrackBatch, planar_layout

GAMMA = chi_square_quantile(0.99, 4)
#: Square metres a track: its gate holds some other tracks now and then.
ROOM_M2 = 1000.0
#: The loop is timed on so many pairs and scaled up.
SAMPLE = 2000
STEP_NS = 100_000_000


def run() -> Iterator[Result]:
    """Measure the association of sparse scenes, and whole steps of the centre."""
    for count in (1000, 5000):
        yield from _association(count)
    for count in (1, 10, 100, 1000):
        yield _step(count)


def _scene(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    """Tracks over an area that grows with their number."""
    mean = np.concatenate([rng.uniform(0, np.sqrt(count * ROOM_M2), (count, 2)), rng.normal(0, 10, (count, 2))], 1)
    root = 0.5 * rng.normal(size=(count, 4, 6))
    return mean, root @ np.swapaxes(root, 1, 2)


def _seen(rng: np.random.Generator, mean: Array, cov: Array) -> Array:
    """Estimates of the targets with errors as their covariances say."""
    return mean + (np.linalg.cholesky(cov) @ rng.normal(size=(*mean.shape, 1)))[..., 0]


def _association(count: int) -> Iterator[Result]:
    rng = np.random.default_rng(count)
    mean, cov = _scene(rng, count)
    order = rng.permutation(count)
    rows, cols = (_seen(rng, mean, cov)[order], cov[order]), (_seen(rng, mean, cov), cov)
    part = max(1, SAMPLE // count)
    dense = np.asarray(np.abs(rows[0][:, None, :2] - cols[0][None, :, :2]).sum(-1))

    ours, loop, alone = race(
        lambda: nearest_neighbour(*rows, *cols, GAMMA, (0, 1)),
        lambda: association_costs_by_loop(rows[0][:part], rows[1][:part], *cols, GAMMA),
        lambda: linear_sum_assignment(dense),
    )
    users = loop * count / part + alone
    name = f"gate and assign {count} x {count}"
    yield Result(name, ours, f"Python loop + dense assignment, {users:.3g} s", users / ours, at_least=100.0)
    yield Result(name, ours, f"the dense assignment alone, {alone * 1e3:.3g} ms", alone / ours)


def _step(count: int) -> Result:
    """One step of the centre with covariance intersection: every target seen by two sources."""
    rng, layout = np.random.default_rng(count), planar_layout()
    motion = NearlyConstantVelocity(layout, MotionParams())
    rule, sources = RULES["covariance_intersection"], (SourceConfig("sensor_1"), SourceConfig("sensor_2"))
    centre = FusionCentre(CentreConfig(sources, motion, "map", rule, rule.params()))
    mean, cov = _scene(rng, count)
    mean[:, 2:] = 0.0
    scans = [TrackBatch.gaussian(layout, "map", _seen(rng, mean, cov), cov) for _ in range(2)]
    time_ns = 0

    def step() -> None:
        nonlocal time_ns
        time_ns += STEP_NS
        centre.step(time_ns, {k: s.replace(time_ns=np.full(count, time_ns)) for k, s in enumerate(scans)})

    return Result(f"a step of the centre, {count} track{'s' * (count > 1)}, 2 sources", race(step)[0])
