"""Sharma et al., section 6.4: three radars, 20 targets, clutter, and a fusion centre with memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from track_fusion.linalg import Array
from track_fusion.metrics.accuracy import Estimate
from track_fusion.rules import RULES
from track_fusion.scenarios.sharma import PAPER
from track_fusion.scenarios.sharma.radar_runs import (
    CATEGORIES,
    COLUMNS,
    FUSION_SCANS,
    FUSION_TIMES_S,
    LAYOUT,
    REACH_M,
    RULE_CHOICES,
    category,
    judge,
    scene,
    seen,
    seen_by,
    tracked,
)
from track_fusion.study.chart import Chart, Series
from track_fusion.study.claim import Claim
from track_fusion.study.rows import Outcomes, Progress, chosen
from track_fusion.study.rule_choice import RuleChoice
from track_fusion.study.scenario import Scenario

#: Fusions from this time on count: before it tracks are still starting.
SETTLED_S = 60.0
SETTLED = int(np.searchsorted(FUSION_TIMES_S, SETTLED_S))
CI, ICI, HMD = "covariance_intersection", "inverse_covariance_intersection", "harmonic_mean"
FIELD, ALONE = "given-field_of_view", "pda-alone"
PAPER_ROWS = tuple(f"pda-{rule}" for rule in (CI, ICI, HMD))


def simulate(runs: Sequence[int], seed: int, progress: Progress, only: str = "") -> Outcomes:
    """Run the rows whose names start with `only`: radars alone, and each rule.

    Returns
    -------
    {row/position: (R, F, 20, 2), row/nees, row/variance: (R, F, 20), row/false: (R, F)}, F fusions; number of radars
    that see each target at mid-life, (R, 20)
    """
    rows: dict[str, RuleChoice | None] = {FIELD: None, ALONE: None}
    rows = chosen(rows | {f"pda-{choice.name}": choice for choice in RULE_CHOICES}, only)
    field = {f"{FIELD}/radars": np.tile(seen_by().astype(float), (len(runs), 1))} if FIELD in rows else {}
    rows.pop(FIELD, None)
    return field | (tracked(rows, runs, seed, progress) if rows else {})


class Record(NamedTuple):
    """A row's errors against the truth, NaN where a target is lost: (R, F, N) each, and false tracks (R, F)."""

    square: Array
    nees: Array
    variance: Array
    false: Array

    def of(self, targets: NDArray[np.intp], since: int = 0) -> Record:
        """Only some targets, and only from a fusion on."""
        square, score, variance = (part[:, since:, targets] for part in self[:3])
        return Record(square, score, variance, self.false[:, since:])


def records(outcomes: Outcomes) -> dict[str, Record]:
    """Return the record of each row."""
    truth = scene().states(0, 0)[FUSION_SCANS::FUSION_SCANS][..., list(LAYOUT.position)]

    def record(row: str) -> Record:
        position, score, variance, false = (outcomes[f"{row}/{column}"] for column in COLUMNS)
        return Record(((position - truth) ** 2).sum(-1), score, variance, false)

    return {row: record(row) for row in (n.removesuffix("/nees") for n in outcomes if n.endswith("/nees"))}


def figures(outcomes: Outcomes) -> dict[str, Estimate]:
    """Error, NEES, claimed error and share of lost tracks by category, from SETTLED_S on; false tracks at a time."""
    measured: dict[str, Estimate] = {}
    if f"{FIELD}/radars" in outcomes:
        measured |= {f"{FIELD}/category_{c}_targets_1": Estimate.exact(len(category(c))) for c in CATEGORIES}
    table = records(outcomes)
    for row, record in table.items():
        for c in CATEGORIES:
            measured |= {f"{row}/category_{c}_{name}": e for name, e in _figures_of(record, category(c)).items()}
        for number in CATEGORIES["a"]:
            measured[f"{row}/target_{number}_rmse_m"] = _figures_of(record, np.array([number - 1]))["rmse_m"]
        measured[f"{row}/false_tracks_1"] = Estimate.mean(record.false[:, SETTLED:].mean(1))
    if all(row in table for row in PAPER_ROWS):
        for c in CATEGORIES:
            measured[f"{PAPER_ROWS[-1]}/category_{c}_least_1"] = _share_of_least(table, category(c))
    return measured


def _figures_of(record: Record, targets: NDArray[np.intp]) -> dict[str, Estimate]:
    """Pool targets and times; a target counts as lost where a radar sees it and no central track is near."""
    record = record.of(targets, SETTLED)
    parts = np.stack([np.isfinite(record.nees), _lost(record, targets), *np.nan_to_num(record[:3])], -1).sum(
        (1, 2)
    )  # (R, 5)

    def pooled(statistic: Callable[[Array], Array]) -> Estimate:
        with np.errstate(invalid="ignore", divide="ignore"):
            return Estimate.of_averages(parts, statistic)

    return {
        "rmse_m": pooled(lambda s: np.sqrt(s[:, 2] / s[:, 0])),
        "nees_1": pooled(lambda s: s[:, 3] / s[:, 0]),
        "claimed_m": pooled(lambda s: np.sqrt(s[:, 4] / s[:, 0])),
        "lost_1": pooled(lambda s: s[:, 1] / (s[:, 0] + s[:, 1])),
    }


def _lost(record: Record, targets: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Tell where a target that some radar sees has no track, (R, F, N), of a record of these from SETTLED_S on."""
    in_view = seen()[FUSION_SCANS::FUSION_SCANS][SETTLED:, :, targets].any(1)
    return np.asarray(np.isnan(record.nees) & in_view)


def _share_of_least(table: Mapping[str, Record], targets: NDArray[np.intp]) -> Estimate:
    """Share of the fusions at which HMD-GA has the least error of the paper's rules, targets and runs pooled."""
    of = [table[row].of(targets, SETTLED) for row in PAPER_ROWS]
    parts = np.stack([[np.nansum(r.square, 2), np.isfinite(r.nees).sum(2)] for r in of])  # (rule, 2, R, F)
    return Estimate.of_averages(
        np.moveaxis(parts, 2, 0),
        lambda s: np.asarray((np.argmin(s[:, :, 0] / s[:, :, 1], 1) == len(of) - 1).mean(-1)),
    )


def charts(outcomes: Outcomes) -> list[Chart]:
    """The map (Fig. 8), and error and NEES over time by category (Figs. 9-27 are such plots of each target)."""
    table, panels = records(outcomes), []
    if f"pda-{HMD}/position" in outcomes:
        panels.append(_map(outcomes[f"pda-{HMD}/position"][0]))
    for c in CATEGORIES if table else ():
        parts = {_label(row): record.of(category(c)) for row, record in table.items()}
        errors = [Series(row, FUSION_TIMES_S, np.sqrt(_over_time(part.square))) for row, part in parts.items()]
        scores = [Series(row, FUSION_TIMES_S, _over_time(part.nees)) for row, part in parts.items()]
        scores.append(Series("4: consistent", FUSION_TIMES_S[[0, -1]], np.full(2, 4.0), "dotted"))
        title = f"Category {c.upper()}: {{}} of the tracks found"
        panels.append(Chart(title.format("position error"), "time, s", "RMSE, m", tuple(errors)))
        panels.append(Chart(title.format("NEES"), "time, s", "NEES", tuple(scores)))
    return panels


def _over_time(values: Array) -> Array:
    """Average what is there over runs and targets: (R, F, N) -> (F,), NaN where nothing is."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.nansum(values, (0, 2)) / np.isfinite(values).sum((0, 2)))


def _label(row: str) -> str:
    key = row.removeprefix("pda-").partition("@")[0]
    return "nearest radar alone" if row == ALONE else RULES[key].title


def _map(position: Array) -> Chart:
    """Reach of the radars, courses of the targets, and the tracks found in one run, position (F, 20, 2); km."""
    angle, lines = np.linspace(0.0, 2.0 * np.pi, 73), []
    for name, radar in scene().radars.items():
        ring = np.array(radar.sensor.location) + radar.reach_m * np.stack([np.cos(angle), np.sin(angle)], -1)
        lines.append(Series(f"reach of {name.replace('_', ' ')}", ring[:, 0] / 1e3, ring[:, 1] / 1e3, "dashed"))
    course = scene().states(0, 0)[:: 2 * FUSION_SCANS, :, :2]
    broken = np.concatenate([course, np.full((1, *course.shape[1:]), np.nan)]).swapaxes(0, 1).reshape(-1, 2)
    lines.append(Series("targets", np.nan_to_num(broken[:, 0]) / 1e3, broken[:, 1] / 1e3))
    dots = position[np.isfinite(position[..., 0])]
    lines.append(Series("central tracks by HMD-GA, one run", dots[:, 0] / 1e3, dots[:, 1] / 1e3, "points"))
    return Chart("Radars and targets", "east of radar 1, km", "north of radar 1, km", tuple(lines), equal=True)


def scores(rules: Sequence[RuleChoice], runs: Sequence[int], seed: int, progress: Progress) -> Outcomes:
    """Fuse the same tracks by any rules: error of the tracks found, and share of lost ones, over all targets judged.

    Returns
    -------
    {row/position_rmse_m, row/lost_1: (R,)}; the error is REACH_M where a run found nothing
    """
    table = records(tracked({f"pda-{choice.name}": choice for choice in rules}, runs, seed, progress))
    targets = np.concatenate([category(c) for c in CATEGORIES])
    columns: Outcomes = {}
    for row, record in table.items():
        part = record.of(targets, SETTLED)
        there = np.isfinite(part.nees)
        lost = _lost(part, targets).sum((1, 2))
        total = np.where(there.any((1, 2)), np.nansum(part.square, (1, 2)), REACH_M**2)
        columns[f"{row}/position_rmse_m"] = np.sqrt(total / np.maximum(there.sum((1, 2)), 1))
        columns[f"{row}/lost_1"] = lost / (there.sum((1, 2)) + lost)
    return columns


def _needs(quantity: str, *rows: str) -> tuple[str, ...]:
    return tuple(f"pda-{row}/{quantity}" for row in rows)


#: How near figures lie that show no difference, as a share.
CLOSE = 0.1


CLAIMS = (
    *(
        Claim.order(f"Category {c.upper()}: CI has a lower NEES than {title}.", "6.4.3",
                    *_needs(f"category_{c}_nees_1", CI, rule))
        for c in "ab" for title, rule in (("ICI", ICI), ("HMD-GA", HMD))
    ),
    Claim.close("Category A: the NEES of ICI and HMD-GA show no difference (a tenth at most).", "6.4.3", CLOSE,
                *_needs("category_a_nees_1", ICI, HMD)),
    Claim.close("Category C: CI is no more conservative than ICI and HMD-GA (NEES within a tenth).", "6.4.3", CLOSE,
                *_needs("category_c_nees_1", CI, ICI, HMD)),
    *(
        Claim.order(f"The NEES of {title} is lower in category B than in A.", "6.4.3",
                    f"pda-{rule}/category_b_nees_1", f"pda-{rule}/category_a_nees_1")
        for title, rule in (("CI", CI), ("ICI", ICI), ("HMD-GA", HMD))
    ),
    *(
        Claim.below(f"Category {c.upper()}: HMD-GA is conservative (NEES at most 4).", "6.4.3, 7", 4.0,
                    *_needs(f"category_{c}_nees_1", HMD))
        for c in CATEGORIES
    ),
    *(
        Claim.order(f"Category {c.upper()}: HMD-GA claims a smaller error than ICI.", "6.4.3, A",
                    *_needs(f"category_{c}_claimed_m", HMD, ICI))
        for c in CATEGORIES
    ),
    Claim.above("Category A: HMD-GA has the least error of the three most of the time.", "6.4.3", 0.5,
                *_needs("category_a_least_1", HMD)),
    *(
        Claim.order(f"Category {c.upper()}: HMD-GA has a smaller error than {title}.", "7",
                    *_needs(f"category_{c}_rmse_m", HMD, rule))
        for c in CATEGORIES for title, rule in (("CI", CI), ("ICI", ICI))
    ),
    Claim.close("Category A: the error of CI is close to that of ICI (within a tenth).", "6.4.3", CLOSE,
                *_needs("category_a_rmse_m", ICI, CI)),
    Claim.order("HMD-GA: the error is least in category A and largest in C.", "6.4.3",
                *(f"pda-{HMD}/category_{c}_rmse_m" for c in "abc")),
    Claim.order("HMD-GA: of category A target 10 has the least error and target 4 the largest.", "6.4.3",
                *(f"pda-{HMD}/target_{number}_rmse_m" for number in (10, 15, 4))),
    Claim.close("Category C: the error is that of the radar alone (within a tenth).", "6.4.3", CLOSE,
                *_needs("category_c_rmse_m", "alone", CI, ICI, HMD)),
)  # fmt: skip

SCENARIO = Scenario(
    key="sharma-radars",
    title="Three radars, 20 targets, clutter, and a centre with memory",
    paper=f"{PAPER}, 6.4, Table 3, Figs. 8-27",
    shows="what CI, ICI and HMD-GA claim and attain when a centre fuses radar tracks with its own predicted track",
    published={f"{FIELD}/category_{c}_targets_1": len(numbers) for c, numbers in CATEGORIES.items()},
    published_runs=200,
    default_runs=8,
    publication_runs=50,
    assumptions=(
        "Table 2 is missing from the paper's text; assumed: 300 s, a scan every 2 s, range 50 m and bearing 0.2 deg "
        "(standard deviations), process noise 10 m^2/s^3, detection probability 0.9, gate probability 0.99, 5e-3 false "
        "detections per metre and radian in a scan, field of view 300 km",
        "assumed: a fusion every 10 s (after every fifth scan), no feedback to the radars",
        "assumed: targets move at constant speed on straight lines between the coordinates of Table 3, with a weave of "
        "400 m across, once in 150 s; all live 300 s at zero altitude; the truth is the same in all runs",
        "assumed: one plane for all, tangent to the WGS 84 ellipsoid at radar 1, where the centre is (x east, y "
        "north); the height of targets and radars above it is left out",
        "a category is the number of radars that see the target at mid-life; of targets that the paper has in one: "
        "target 12, published in B, is seen by radar 2 alone and judged in C; 1 and 19 are in none",
        "assumed: radar tracks start from pairs of detections with probability of existence 0.01 (speeds of 150 m/s), "
        "count from 0.99 on, end below 0.001; a target survives a scan with 0.99",
        "the centre fuses the predicted central track first, then the radars in their order; CI all at once; all "
        "weights by the determinant",
        "assumed: central tracks count after 2 of 3 updates of one radar, end after 2 misses in a row of every "
        "radar that ever saw them, or after 25 s; association gate 0.99 by (88) with the inverse, plus log det",
        "tracks and targets are paired one to one within 3 km; a target in view without a track counts as lost, not as "
        "an error; figures from 60 s on, targets and times pooled",
        "nearest radar alone: for each target the track of the radar nearest to it",
    ),
    simulate=simulate,
    figures=figures,
    charts=charts,
    claims=CLAIMS,
    piece=1,
    scene=scene,
    judge=judge,
    rules=RULE_CHOICES,
    scores=scores,
)
