"""Ghosts, identities and GOSPA of the centre with its defaults, beside a single gate without links."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from benchmark import scenes
from benchmark.measure import Result
from benchmark.scenes import Scene, tracked, two_trackers
from track_fusion.centre.centre import FusionCentre
from track_fusion.centre.config import CentreConfig, FusionCentreParams, SourceConfig
from track_fusion.linalg import Array
from track_fusion.metrics.gospa import SetDistanceParams, set_distance
from track_fusion.rules import RULES

#: Who is farther than this from a target does not track it; errors count squared.
GOSPA = SetDistanceParams(cutoff_m=6.0, order=2.0)
PERIOD_S = 0.1


def single_gate(probability: float) -> dict[str, Any]:
    """Parameters of a centre without memory of who fed what: one gate alone."""
    return {"gate_probability": probability, "keep_probability": probability, "patience": 0, "merge_duplicates": "off"}


@dataclasses.dataclass(frozen=True)
class Score:
    """How a centre did in a scene, step by step (K): what was published and what lived, GOSPA; and over all of it.

    `switches` counts how often a target's track got another identifier, `ids` all that were published; `same` tells
    whether every target that was tracked has at last the identifier that it had at first.
    """

    published: Array
    living: Array
    gospa: Array
    switches: int
    ids: int
    same: bool

    @property
    def ghosts(self) -> float:
        """Share of steps with more tracks than targets."""
        return float((self.published > self.living).mean())


def centre_of(sources: int = 2, **params: Any) -> FusionCentre:
    """Make a centre of default parameters but these."""
    rule, names = RULES["covariance_intersection"], tuple(SourceConfig(f"sensor_{k}") for k in range(sources))
    return FusionCentre(CentreConfig(names, scenes.MOTION, "map", rule, rule.params(), FusionCentreParams(**params)))


def score(scene: Scene, **params: Any) -> Score:
    """Run a centre through a scene and judge what it publishes."""
    centre, rows = centre_of(len(scene.reports), **params), []
    first: dict[int, int] = {}
    last: dict[int, int] = {}
    switches, ids = 0, set[int]()
    for time_ns, scans, truth in scene.steps():
        fused, _ = centre.step(time_ns, scans)
        living = np.flatnonzero(np.isfinite(truth[:, 0]))
        of_target, gospa = judged(fused.mean[:, 0, :2], truth[living])
        rows.append((len(fused), len(living), gospa))
        for i, j in of_target.items():
            target, own = int(living[j]), int(fused.track_id[i])
            first.setdefault(target, own)
            switches += last.get(target, own) != own
            last[target] = own
        ids.update(fused.track_id.tolist())
    return Score(*np.array(rows).T, switches, len(ids), first == last)


def judged(tracks: Array, truth: Array) -> tuple[dict[int, int], float]:
    """Pair tracks with targets, positions (N, 2) and (L, 2): pairs, and GOSPA."""
    result = set_distance(truth, tracks, GOSPA)
    return dict(zip(result.track.tolist(), result.target.tolist(), strict=True)), result.gospa


class Row(NamedTuple):
    """A scene of the table: how it is made, from a stream and whether the second source is late, in so many draws."""

    make: Callable[[np.random.Generator, bool], Scene]
    draws: int = 1
    params: dict[str, Any] = {}


def side_by_side(
    rng: np.random.Generator, staggered: bool, sds: tuple[float, float] = (1.0, 1.0), *, count: int = 20,
    spacing_m: float = 1000.0, seconds: float = 150.0, period_s: float = PERIOD_S, **second: Any,
) -> Scene:  # fmt: skip
    """Targets in formation, seen by two Kalman trackers; keywords change what the second tells."""
    start = scenes.grid_of(count, spacing_m)
    targets = scenes.moving(rng, start, seconds, period_s, together=True)
    return two_trackers(rng, targets, sds, staggered, **second)


def in_white_noise(rng: np.random.Generator, staggered: bool) -> Scene:
    """Five targets whose estimates have errors drawn anew at each scan."""
    targets, first = scenes.moving(rng, scenes.grid_of(5, 1000.0), 60.0, PERIOD_S), (0, int(staggered))
    told = (scenes.white(rng, targets, sd, first=at) for sd, at in zip((1.0, 2.0), first, strict=True))
    return Scene(targets, tuple(told), first)


def crossed(rng: np.random.Generator, staggered: bool, speed: float, sds: tuple[float, float], swap: bool) -> Scene:
    """Two targets that pass each other at a metre; the second source may swap their identifiers as they do."""
    targets = scenes.crossing(speed)
    middle = len(targets.state) // 4
    change = (lambda told: scenes.swapped(told, middle)) if swap else (lambda told: told)
    return two_trackers(rng, targets, sds, staggered, change)


def split(rng: np.random.Generator, staggered: bool) -> Scene:
    """Five targets, each told twice by the second source: by two filters with measurements of their own."""
    targets = scenes.moving(rng, scenes.grid_of(5, 1000.0), 60.0, PERIOD_S)
    twice = lambda told: scenes.joined(told, tracked(rng, targets, 1.0, first=int(staggered)))  # noqa: E731
    return two_trackers(rng, targets, (1.0, 1.0), staggered, twice)


def table() -> dict[str, Row]:
    """Every scene by name."""
    rows = {}
    for spacing_m, sd in itertools.product((1000.0, 3.0), (1.0, 2.0, 4.0, 8.0)):
        rows[f"20 targets {spacing_m:g} m apart, sd 1 and {sd:g} m"] = Row(
            lambda rng, late, spacing_m=spacing_m, sd=sd: side_by_side(rng, late, (1.0, sd), spacing_m=spacing_m)
        )
    for rate in (10.0, 30.0):
        rows[f"5 targets at {rate:g} Hz, 60 s, sd 1 and 2 m"] = Row(
            lambda rng, late, rate=rate: side_by_side(rng, late, (1.0, 2.0), count=5, seconds=60.0, period_s=1.0 / rate)
        )
    rows["5 targets, white errors, 60 s"] = Row(in_white_noise)
    for share in (4, 16):
        rows[f"20 targets, one covariance 1/{share}"] = Row(
            lambda rng, late, share=share: side_by_side(rng, late, claim=1.0 / share)
        )
    rows["20 targets, one source restarts every 5 s"] = Row(lambda rng, late: side_by_side(rng, late, restart=50))
    rows["20 targets, ids of one source shuffled at each scan"] = Row(
        lambda rng, late: side_by_side(rng, late, second=lambda told: scenes.shuffled(rng, told))
    )
    for sds, speed, swap in itertools.product(((1.0, 1.0), (0.3, 1.0)), (0.5, 1.0, 4.0), (False, True)):
        rows[f"crossing at {speed:g} m/s, sd {sds[0]:g} and {sds[1]:g} m{', ids swapped' * swap}"] = Row(
            lambda rng, late, sds=sds, speed=speed, swap=swap: crossed(rng, late, speed, sds, swap), draws=100
        )
    rows["5 targets, one source tells each twice"] = Row(split, params={"merge_duplicates": "also_within_a_source"})
    return rows


def is_right(result: Score, targets: int) -> bool:
    """Whether every target has at last the identifier of the start, and no other was ever published, none lost.

    While targets are near each other, whose track is whose is a matter of noise, so that switches between do not count.
    """
    settled = result.published[len(result.published) // 10 :]
    return result.same and result.ids == targets and bool((settled == targets).all())


def run() -> Iterator[Result]:
    """Run every scene under both triggers, before and after."""
    for (name, row), staggered in itertools.product(table().items(), (False, True)):
        centres = {"before": single_gate(0.99), "after": row.params}
        results: dict[str, list[Score]] = {key: [] for key in centres}
        for draw in range(row.draws):
            scene = row.make(np.random.default_rng(draw), staggered)
            for key, params in centres.items():
                results[key].append(score(scene, **params))
        targets = scene.targets.state.shape[1]
        told = {key: _told(of_centre, targets) for key, of_centre in results.items()}
        trigger = "any_source" if staggered else "all_sources"
        yield Result(f"{name}, {trigger}", against=f"before: {told['before']}", figure=told["after"])


def _told(results: list[Score], targets: int) -> str:
    if len(results) > 1:
        right = sum(is_right(result, targets) for result in results)
        return f"right {right} of {len(results)}"
    (result,) = results
    return (
        f"ghosts {result.ghosts:.1%}, {result.ids} ids, {result.switches} switches, GOSPA {result.gospa.mean():.2f} m"
    )


if __name__ == "__main__":
    for line in run():
        print(f"{line.job}: {line.figure}; {line.against}", flush=True)
