"""Sharma et al., section 6.4: the scene, the radars' trackers, the centre with memory, and one run of it all."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from track_fusion.centre.centre import FusionCentre
from track_fusion.centre.config import (
    CentreConfig,
    FusionCentreParams,
    IdentityParams,
    SourceConfig,
    TrackManagerParams,
)
from track_fusion.linalg import Array
from track_fusion.metrics.pairing import paired
from track_fusion.models.geodetic import LocalFrame
from track_fusion.models.measurement import RangeBearingSensor
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.rules import RULES
from track_fusion.scenarios.sharma.surveillance import Courses, Radar, Surveillance
from track_fusion.study.rows import Outcomes, Progress, run_by_run
from track_fusion.study.rule_choice import RuleChoice
from track_fusion.trackers.many_targets import PdaTracker, PdaTrackerParams
from track_fusion.tracks import SECOND_NS, TrackBatch, planar_layout

#: Table 3: latitude and longitude (degrees north, east) of each target at its start and at its end.
TARGETS = (
    (59.6104, -52.6939, 59.9352, -52.7611),
    (57.7699, -59.1922, 58.0822, -58.7635),
    (60.7648, -55.762, 60.8607, -56.3676),
    (57.7025, -54.7059, 57.3769, -54.7036),
    (59.4254, -54.4498, 59.7284, -54.5691),
    (59.1483, -51.2977, 59.4869, -51.3718),
    (58.8561, -58.484, 58.6288, -58.495),
    (59.831, -58.3974, 59.6367, -58.0819),
    (59.5306, -53.1629, 59.5036, -53.5418),
    (58.8028, -54.3803, 58.6656, -53.5222),
    (57.8132, -52.6504, 57.676, -51.8147),
    (57.4636, -58.9469, 57.5906, -59.8504),
    (57.2096, -52.6824, 57.7325, -52.5499),
    (59.9093, -56.8477, 59.8108, -57.9123),
    (57.5181, -56.2302, 58.1104, -56.6123),
    (58.3548, -56.4447, 58.0948, -56.8321),
    (57.8268, -49.5721, 57.55, -50.3705),
    (60.2969, -49.9242, 60.6296, -49.3978),
    (57.6451, -59.8337, 57.988, -59.1956),
    (60.6533, -51.4683, 61.1832, -51.9363),
)
#: Table 3: latitude and longitude of each radar.
RADARS = {
    "radar_1": (59.7138694, -55.2676093),
    "radar_2": (57.5399008, -57.6551522),
    "radar_3": (56.6320564, -52.104272),
}
#: Section 6.4.3: the targets of each category, seen by three, two radars and one.
CATEGORIES = {"a": (4, 10, 15), "b": (2, 5, 7, 8, 11, 12, 13, 14, 16), "c": (3, 6, 9, 17, 20)}
SEEN_BY = {"a": 3, "b": 2, "c": 1}

LAYOUT = planar_layout()
FRAME = "map"
SCAN_S, STEPS = 2.0, 150
#: The radars send their tracks, and the centre fuses them, at every so many scans.
FUSION_SCANS = 5
#: A target without a central track so near is lost, a track without such a target false.
REACH_M = 3000.0

MOTION = NearlyConstantVelocity(LAYOUT, MotionParams(noise_form="continuous", process_noise=10.0))
TRACKER = PdaTrackerParams(
    detection_probability=0.9,
    gate_probability=0.99,
    clutter_density=5e-3,
    survival_probability=0.99,
    birth_existence=0.01,
    deletion_existence=0.001,
)
MANAGER = TrackManagerParams(confirmation_threshold=(2, 3), deletion_threshold=(2, 2), max_coast_s=25.0)
IDENTITY = IdentityParams("sharma-radars")
RULE_CHOICES = (
    RuleChoice.of("covariance_intersection"),
    RuleChoice.of("inverse_covariance_intersection"),
    RuleChoice.of("harmonic_mean", combine="fold"),
    RuleChoice.of("naive"),
)
FUSION_TIMES_S: Array = SCAN_S * np.arange(FUSION_SCANS, STEPS + 1, FUSION_SCANS, dtype=np.float64)


@cache
def scene() -> Surveillance:
    """Targets and radars in the plane tangent to the Earth at radar 1, where the centre is; x east, y north.

    Raises
    ------
    ImportError    pymap3d is missing
    """
    frame = LocalFrame(*RADARS["radar_1"])

    def plane(degrees: Array) -> Array:
        enu = frame.enu_from_geodetic(np.concatenate([degrees, np.zeros((len(degrees), 1))], 1))
        return enu[:, :2]

    table, places = np.array(TARGETS), plane(np.array(list(RADARS.values())))
    radars = {
        name: Radar(RangeBearingSensor(LAYOUT, 50.0, np.radians(0.2), (float(x), float(y))), 300e3,
                    TRACKER.detection_probability, TRACKER.clutter_density)
        for name, (x, y) in zip(RADARS, places, strict=True)
    }  # fmt: skip
    courses = Courses(plane(table[:, :2]), plane(table[:, 2:]), SCAN_S * STEPS, 400.0, 150.0)
    return Surveillance(LAYOUT, SCAN_S, STEPS, courses, radars)


@cache
def seen() -> NDArray[np.bool_]:
    """Tell at each scan, the start included, which radar sees which target, (STEPS + 1, radars, 20)."""
    return np.stack([radar.sees(scene().states(0, 0)) for radar in scene().radars.values()], 1)


def seen_by() -> NDArray[np.intp]:
    """Number of radars that see each target at mid-life, (20,)."""
    return np.asarray(seen()[STEPS // 2].sum(0))


def category(name: str) -> NDArray[np.intp]:
    """Indices of the targets that are judged as category a, b or c.

    Those that the paper has in any category and that so many radars see at mid-life.
    """
    listed = np.sort(np.concatenate([np.array(numbers) for numbers in CATEGORIES.values()])) - 1
    return np.asarray(listed[seen_by()[listed] == SEEN_BY[name]], np.intp)


def local_tracks(seed: int, run: int, progress: Progress) -> Iterator[tuple[int, dict[int, TrackBatch]]]:
    """Track by every radar; yield each fusion's time in nanoseconds, and the confirmed tracks of each radar."""
    trackers = [PdaTracker(MOTION, radar.sensor, FRAME, TRACKER) for radar in scene().radars.values()]
    for k, scan in enumerate(scene().scans(seed, run), 1):
        time_ns = round(k * SCAN_S * SECOND_NS)
        scans = {i: t.step(time_ns, z) for i, (t, z) in enumerate(zip(trackers, scan.values(), strict=True))}
        progress(k / STEPS)
        if k % FUSION_SCANS == 0:
            yield time_ns, scans


def centre(choice: RuleChoice) -> FusionCentre:
    """Return the fusion centre, with memory, that fuses by this rule."""
    sources = tuple(map(SourceConfig, RADARS))
    rule, params = RULES[choice.key], FusionCentreParams(memory=True)
    config = CentreConfig(sources, MOTION, FRAME, rule, choice.params, params, MANAGER, identity=IDENTITY)
    return FusionCentre(config)


#: What is kept of each target at a fusion, NaN where it is lost, and of the fusion.
COLUMNS = ("position", "nees", "variance", "false")


class Judged(NamedTuple):
    """Tracks against N targets at one time: those paired with a target, NaN where it is lost, and the rest.

    Attributes
    ----------
    position : (N, 2)    estimated, m
    nees : (N,)
    variance : (N,)      claimed: trace of the position's covariance, m^2
    false : ()           number of tracks without a target
    """

    position: Array
    nees: Array
    variance: Array
    false: Array


def judged(tracks: TrackBatch, truth: Array) -> Judged:
    """Pair tracks and targets, truth (N, n), one to one by least total distance, within REACH_M."""
    mean, cov = tracks.moments
    pairs, at, lost = paired(LAYOUT, truth, mean, cov, REACH_M), list(LAYOUT.position), np.full(len(truth), np.nan)
    false = np.array(float(len(mean) - len(pairs.track)))
    position, score, variance = np.full((len(truth), 2), np.nan), lost.copy(), lost
    position[pairs.target] = mean[pairs.track][:, at]
    score[pairs.target] = pairs.nees
    variance[pairs.target] = cov[pairs.track][:, at, at].sum(-1)
    return Judged(position, score, variance, false)


def judged_alone(scans: Mapping[int, TrackBatch], truth: Array) -> Judged:
    """Judge the radars' own tracks: for each target those of the nearest radar; false tracks: average of the radars."""
    parts = [np.stack(part) for part in zip(*(judged(batch, truth) for batch in scans.values()), strict=True)]
    nearest = np.argmin([radar.distance(truth) for radar in scene().radars.values()], 0)
    position, score, variance = (part[nearest, np.arange(len(truth))] for part in parts[:-1])
    return Judged(position, score, variance, parts[-1].mean())


def tracked(rows: Mapping[str, RuleChoice | None], runs: Sequence[int], seed: int, progress: Progress) -> Outcomes:
    """Run rules, and the radars alone (None), on the same tracks of the radars; see :func:`simulate`."""
    return run_by_run(runs, progress, lambda run, tell: _one_run(rows, seed, run, tell))


def _one_run(rows: Mapping[str, RuleChoice | None], seed: int, run: int, progress: Progress) -> dict[str, Array]:
    """Run one Monte Carlo run: {row/column: (F, ...)}."""
    truth = scene().states(seed, run)[FUSION_SCANS::FUSION_SCANS]
    centres = {row: centre(choice) for row, choice in rows.items() if choice is not None}
    steps: dict[str, list[Judged]] = {row: [] for row in rows}
    for states, (time_ns, scans) in zip(truth, local_tracks(seed, run, progress), strict=True):
        for row, kept in steps.items():
            fuser = centres.get(row)
            kept.append(judged_alone(scans, states) if fuser is None else judged(fuser.step(time_ns, scans)[0], states))
    return {name: part for row, kept in steps.items() for name, part in _columns(row, kept).items()}


def _columns(row: str, kept: Sequence[Judged]) -> dict[str, Array]:
    """Stack what is kept of each fusion: {row/column: (F, ...)}."""
    return {f"{row}/{c}": np.stack(values) for c, values in zip(COLUMNS, zip(*kept, strict=True), strict=True)}


def judge(row: str, published: Sequence[TrackBatch]) -> Outcomes:
    """Judge what a centre published at each fusion, as one run of a row of :func:`tracked`."""
    truth = scene().states(0, 0)[FUSION_SCANS::FUSION_SCANS]
    kept = [judged(tracks.to_axes(LAYOUT), states) for tracks, states in zip(published, truth, strict=True)]
    return {name: part[None] for name, part in _columns(row, kept).items()}
