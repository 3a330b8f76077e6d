"""Scenes of targets that sources track by Kalman filters, so that errors persist; benchmarks and tests share them.

A scene is made on a grid of half periods: sources report at even points, or, staggered, the second at odd ones.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from track_fusion.linalg import Array
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.tracks import TrackBatch, planar_layout

Bools = NDArray[np.bool_]
LAYOUT = planar_layout()
#: That of the targets and of every filter: the trackers are consistent.
MOTION = NearlyConstantVelocity(LAYOUT, MotionParams())
#: Standard deviation of a velocity at the start of a track, m/s.
START_SPEED_SD = 1.0
SECOND_NS = 1_000_000_000


@dataclasses.dataclass(frozen=True)
class Targets:
    """True states on the grid, (G, N, 4), and who lives when, (G, N)."""

    state: Array
    alive: Bools
    period_s: float


@dataclasses.dataclass(frozen=True)
class Reports:
    """What a source tells of J tracks at K scans: mean (K, J, 4), cov (K, J, 4, 4), told (K, J), its ids (K, J)."""

    mean: Array
    cov: Array
    told: Bools
    ids: NDArray[np.int64]

    def scan(self, k: int, time_ns: int) -> TrackBatch:
        """Return one scan."""
        at = self.told[k]
        return TrackBatch.gaussian(
            LAYOUT, "map", self.mean[k, at], self.cov[k, at], time_ns=time_ns, track_id=self.ids[k, at]
        )


@dataclasses.dataclass(frozen=True)
class Scene:
    """Targets and what each source tells of them, from its first grid point on every second one."""

    targets: Targets
    reports: tuple[Reports, ...]
    first: tuple[int, ...]

    def steps(self) -> Iterator[tuple[int, dict[int, TrackBatch], Array]]:
        """Give fusion time, new scans and the positions of those that live, (L, 2), NaN for the others."""
        half_ns = round(self.targets.period_s * SECOND_NS) // 2
        for g in range(len(self.targets.state)):
            time_ns = (g + 2) * half_ns
            scans = {
                s: told.scan((g - first) // 2, time_ns)
                for s, (told, first) in enumerate(zip(self.reports, self.first, strict=True))
                if g >= first and (g - first) % 2 == 0
            }
            if scans:
                positions = self.targets.state[g, :, :2].copy()
                positions[~self.targets.alive[g]] = np.nan
                yield time_ns, scans, positions


def moving(
    rng: np.random.Generator, start: Array, seconds: float, period_s: float, *, together: bool = False,
    steady: bool = False,
) -> Targets:  # fmt: skip
    """Targets of nearly constant velocity from their starts, (N, 4); together: disturbed alike; steady: not at all."""
    count = 2 * round(seconds / period_s)
    transition, factor = MOTION.matrices(period_s / 2)[0], MOTION.noise_factor(period_s / 2)
    state = np.empty((count, *start.shape))
    state[0] = start
    for g in range(1, count):
        noise = rng.normal(size=(1 if together else len(start), factor.shape[1])) * (not steady)
        state[g] = state[g - 1] @ transition.T + noise @ factor.T
    return Targets(state, np.ones(state.shape[:2], bool), period_s)


def grid_of(count: int, spacing_m: float) -> Array:
    """Starts of targets at rest on a square grid, (N, 4)."""
    side = int(np.ceil(np.sqrt(count)))
    at = np.arange(count)
    return np.stack([at % side * spacing_m, at // side * spacing_m, 0.0 * at, 0.0 * at], 1)


def tracked(
    rng: np.random.Generator, targets: Targets, sd: float, *, first: int = 0, misses: float = 0.0, lag: int = 0,
    restart: int | None = None, claim: float = 1.0, bias: float = 0.0,
) -> Reports:  # fmt: skip
    """Track every target by a Kalman filter of its own.

    Parameters
    ----------
    sd : float         of a measured position, m
    first : int        grid point of the first scan, 0 or 1
    misses : float     share of scans without detection, which are not told either
    lag : int          scans that a track outlives its target by
    restart : int      scans after which the tracker forgets all and gives new ids; None: never
    claim : float      factor of the covariance that it tells
    bias : float       of x, m
    """
    state, alive = targets.state[first::2], targets.alive[first::2]
    scans, count = alive.shape
    transition, noise = MOTION.matrices(targets.period_s)
    mean, cov = np.zeros((scans, count, 4)), np.zeros((scans, count, 4, 4))
    told, ids = np.zeros((scans, count), bool), np.zeros((scans, count), np.int64)
    m, p = np.zeros((count, 4)), np.tile(np.eye(4), (count, 1, 1))
    known, left = np.zeros(count, bool), np.zeros(count, int)
    start_cov = np.diag([sd**2, sd**2, START_SPEED_SD**2, START_SPEED_SD**2])
    for k in range(scans):
        known &= not (restart and k % restart == 0)
        seen = alive[k] & (rng.random(count) >= misses)
        z = state[k, :, :2] + sd * rng.normal(size=(count, 2))
        m, p = m @ transition.T, transition @ p @ transition.T + noise
        gain = p[:, :, :2] @ np.linalg.inv(p[:, :2, :2] + sd**2 * np.eye(2))
        update = (known & seen)[:, None]
        m = np.where(update, m + (gain @ (z - m[:, :2])[..., None])[..., 0], m)
        p = np.where(update[..., None], p - gain @ p[:, :2], p)
        born = seen & ~known
        m[born] = np.concatenate([z[born], state[k, born, 2:] + START_SPEED_SD * rng.normal(size=(born.sum(), 2))], 1)
        p[born] = start_cov
        left = np.where(alive[k], lag, left - 1)
        known = (known | born) & (left >= 0)
        mean[k], cov[k], told[k] = (
            m + [bias, 0, 0, 0],
            claim * (p + np.swapaxes(p, 1, 2)) / 2,
            known & (seen | ~alive[k]),
        )
        ids[k] = np.arange(count) + 1000 * (k // restart if restart else 0)
    return Reports(mean, cov, told, ids)


def white(rng: np.random.Generator, targets: Targets, sd: float, *, first: int = 0) -> Reports:
    """Tell states with errors drawn anew at each scan."""
    state = targets.state[first::2]
    deviation = np.array([sd, sd, START_SPEED_SD, START_SPEED_SD])
    cov = np.broadcast_to(np.diag(deviation**2), (*state.shape, 4))
    ids = np.broadcast_to(np.arange(state.shape[1]), state.shape[:2])
    return Reports(state + deviation * rng.normal(size=state.shape), cov, targets.alive[first::2], ids)


def shuffled(rng: np.random.Generator, reports: Reports) -> Reports:
    """Give the ids of each scan in an order of its own."""
    return dataclasses.replace(reports, ids=rng.permuted(reports.ids, axis=1))


def swapped(reports: Reports, scan: int) -> Reports:
    """Exchange the ids of two tracks from a scan on."""
    ids = reports.ids.copy()
    ids[scan:] = ids[scan:, ::-1]
    return dataclasses.replace(reports, ids=ids)


def joined(*parts: Reports) -> Reports:
    """Make the tracks of several one source's, the ids of each part apart from the others'."""
    ids = [part.ids + 100_000 * i for i, part in enumerate(parts)]
    fields = {name: np.concatenate([getattr(p, name) for p in parts], 1) for name in ("mean", "cov", "told")}
    return Reports(**fields, ids=np.concatenate(ids, 1))


def false_tracks(
    rng: np.random.Generator, scans: int, period_s: float, rate: float, low: Array, high: Array, sd: float
) -> Reports:
    """Tracks of nothing: so many new ones a scan, 2 to 15 scans long, inside a box (corners (2,)), at walking speed."""
    first = np.repeat(np.arange(scans), rng.poisson(rate, scans))
    length, count = rng.integers(2, 16, len(first)), len(first)
    start, speed = rng.uniform(low, high, (count, 2)), rng.normal(0.0, 2.0, (count, 2))
    age = np.arange(scans)[:, None] - first
    position = start + speed * (age * period_s)[..., None] + 0.1 * sd * rng.normal(size=(scans, count, 2))
    mean = np.concatenate([position, np.broadcast_to(speed, position.shape)], -1)
    cov = np.broadcast_to(np.diag([sd**2, sd**2, 1.0, 1.0]) / 4, (scans, count, 4, 4))
    return Reports(mean, cov, (age >= 0) & (age < length), np.broadcast_to(np.arange(count), age.shape))


def crowd(rng: np.random.Generator, seconds: float, period_s: float, beside_m: float, life_s: float = 25.0) -> Targets:
    """Thirty targets; whenever one dies another is born so far from one that lives, and about as fast."""
    slots, half_s = 30, period_s / 2
    count, life = 2 * round(seconds / period_s), round(life_s / half_s)
    transition, factor = MOTION.matrices(half_s)[0], MOTION.noise_factor(half_s)
    total = slots * (2 + count // life)
    state, alive = np.zeros((count, total, 4)), np.zeros((count, total), bool)
    living, ends, used = np.arange(slots), rng.integers(1, life, slots), slots
    now = np.zeros((total, 4))
    now[:slots] = np.concatenate([rng.uniform(-50, 50, (slots, 2)), rng.normal(0, 2, (slots, 2))], 1)
    for g in range(count):
        for slot in np.flatnonzero(ends == g):
            other, angle = living[rng.choice(np.delete(np.arange(slots), slot))], rng.uniform(0, 2 * np.pi)
            beside = beside_m * np.array([np.cos(angle), np.sin(angle)])
            now[used] = now[other] + np.concatenate([beside, rng.normal(0, 0.5, 2)])
            living[slot], ends[slot], used = used, g + life, used + 1
        state[g], alive[g, living] = now, True
        now = now @ transition.T + rng.normal(size=(total, factor.shape[1])) @ factor.T
    return Targets(state[:, :used], alive[:, :used], period_s)


def crossing(speed: float, period_s: float = 0.1, gap_m: float = 1.0) -> Targets:
    """Two targets that meet head-on, so far apart across, and go on straight for as long again."""
    seconds = 2 * (3.0 + 6.0 / speed)
    reach = speed * seconds / 2
    start = np.array([[-reach, 0.0, speed, 0.0], [reach, gap_m, -speed, 0.0]])
    return moving(np.random.default_rng(0), start, seconds, period_s, steady=True)


def two_trackers(
    rng: np.random.Generator, targets: Targets, sds: tuple[float, float], staggered: bool,
    second: Callable[[Reports], Reports] = lambda told: told, **of_second: Any,
) -> Scene:  # fmt: skip
    """Let two Kalman trackers see the targets; what the second tells is changed by `second`."""
    first = (0, int(staggered))
    a = tracked(rng, targets, sds[0])
    b = second(tracked(rng, targets, sds[1], first=first[1], **of_second))
    return Scene(targets, (a, b), first)
