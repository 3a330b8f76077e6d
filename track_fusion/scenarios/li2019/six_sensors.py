"""Li et al. 2019, section 5.2, Fig. 8: intensities (PHDs) of six sensors that miss targets and raise false alarms."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from track_fusion.densities.mixture.mixture import Mixture
from track_fusion.linalg import Array
from track_fusion.metrics.accuracy import Estimate
from track_fusion.random_streams import stream
from track_fusion.scenarios.li2019 import PAPER
from track_fusion.scenarios.li2019.common import exact_geometric, fused_intensity, intensity, scalar_mixture
from track_fusion.study.chart import Chart, Series, estimates
from track_fusion.study.claim import Claim
from track_fusion.study.rows import Outcomes, Progress, chosen, row_by_row
from track_fusion.study.rule_choice import RuleChoice, rule_by_rule
from track_fusion.study.scenario import Scenario

TARGETS = np.array([20.0, 40.0, 70.0, 110.0, 200.0])
SENSORS = 6
DETECTION, FALSE_ALARMS, INTERVAL = 0.9, 1.0, 200.0
#: Assumed: variance of a component, standard deviation of a detection about its target, range of the weights.
VARIANCE, POSITION_SIGMA, WEIGHTS = 25.0, 2.0, (0.5, 1.0)
#: The mass so near to a target is its own; further away than FAR from every target it belongs to none.
NEAR, FAR = 8.0, 15.0
#: The two targets that are nearest to each other, and half-way.
BETWEEN = np.array([20.0, 30.0, 40.0])
#: Where intensities that are no mixtures are evaluated: all mass inside, the edges of NEAR and FAR between two points.
X = np.arange(-60.0, 280.0, 0.5) + 0.25

AVERAGE = RuleChoice.of("mixture_average", max_components=0)
#: Twenty components carry the masses to one part in a thousand, at a hundredth of the time that a hundred take.
HYBRID = RuleChoice.of("mixture_hybrid", max_components=20)
AA, GA, EXACT = "given-mixture_average", "given-mixture_hybrid", "given-mixture_hybrid@exact"


# Trials.


def scan(rng: np.random.Generator, certain: bool = False) -> tuple[NDArray[np.bool_], Array]:
    """Draw what one sensor sees: which targets it detects (5,), all if `certain`, and where its components are.

    A sensor that sees nothing looks again: without any component there is no density.
    """
    while True:
        seen = rng.random(len(TARGETS)) < (1.0 if certain else DETECTION)
        detections = (TARGETS + POSITION_SIGMA * rng.standard_normal(len(TARGETS)))[seen]
        places = np.concatenate([detections, rng.uniform(0.0, INTERVAL, rng.poisson(FALSE_ALARMS))])
        if len(places):
            return seen, places


def trials(runs: Sequence[int], seed: int, certain: bool = False) -> tuple[Mixture, NDArray[np.bool_]]:
    """Draw trials.

    Returns
    -------
    the sensors' intensities (R, 6, C), padded with components of weight 0, and who detected what (R, 6, 5)
    """
    scans, weights = [], []
    for run in runs:
        for sensor in range(SENSORS):
            rng = stream(seed, run, f"sensor_{sensor + 1}")
            scans.append(scan(rng, certain))
            weights.append(rng.uniform(*WEIGHTS, len(scans[-1][1])))
    count = max(map(len, weights))
    weight = np.stack([np.pad(w, (0, count - len(w))) for w in weights])
    mean = np.stack([np.pad(places, (0, count - len(places)), "edge") for _, places in scans])
    shape = len(runs), SENSORS, -1
    parts = scalar_mixture(weight.reshape(shape), mean.reshape(shape), np.full_like(mean, VARIANCE).reshape(shape))
    return parts, np.stack([seen for seen, _ in scans]).reshape(shape)


# What becomes of them.


class Kept(NamedTuple):
    """What is left of trials: expected number of targets NEAR each (R, 5), FAR from all (R,), intensity at BETWEEN."""

    near: Array
    far: Array
    between: Array

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Which targets are lost, (R, 5)."""
        return np.asarray(self.near < least_mass())

    @property
    def mixed(self) -> NDArray[np.bool_]:
        """Where the two nearest targets have become one: more intensity half-way than at either, (R,)."""
        return np.asarray(self.between[:, 1] > np.maximum(self.between[:, 0], self.between[:, 2]))


def of_mixtures(mixture: Mixture) -> Kept:
    """What is kept in mixtures (R, C)."""
    deviation = np.sqrt(mixture.cov[..., 0, 0])[..., None]

    def below(edge: Array) -> Array:
        share = ndtr((edge - mixture.mean) / deviation)
        return np.asarray((mixture.weight[..., None] * share).sum(-2))

    near = below(TARGETS + NEAR) - below(TARGETS - NEAR)
    gaps = below(np.append(TARGETS - FAR, np.inf)) - below(np.append(-np.inf, TARGETS + FAR))
    return Kept(near, gaps.clip(0).sum(-1), intensity(mixture, BETWEEN))


def on_grid(values: Array) -> Kept:
    """What is kept in intensities at X, (R, S)."""
    distance, step = np.abs(X[:, None] - TARGETS), X[1] - X[0]
    far = (distance.min(-1) > FAR).astype(float)
    beside = np.abs(X[:, None] - BETWEEN) < step  # a point to either side
    return Kept(values @ (distance < NEAR) * step, values @ far * step, values @ beside / 2.0)


@functools.cache
def least_mass() -> float:
    """Mass below which a target counts as lost: half of the arithmetic average's median with all six detecting."""
    parts, _ = trials(range(2000), 0, certain=True)
    return float(0.5 * np.median(of_mixtures(fused_intensity(AVERAGE, parts)).near))


Fusion = Callable[[Mixture], Kept]


def by_rule(choice: RuleChoice, sensors: int = SENSORS) -> Fusion:
    """Fuse the first so many sensors by a rule, scaled to their mean number of targets."""
    return lambda parts: of_mixtures(fused_intensity(choice, parts.at((slice(None), slice(sensors)))))


def _rows() -> dict[str, Fusion]:
    rows = {AA: by_rule(AVERAGE), GA: by_rule(HYBRID), EXACT: lambda parts: on_grid(exact_geometric(parts, X))}
    for choice in (AVERAGE, HYBRID):
        for count in range(2, SENSORS):
            rows[f"given-{choice.name}@sensors{count}"] = by_rule(choice, count)
    return rows


ROWS = _rows()


def simulate(runs: Sequence[int], seed: int, progress: Progress, only: str = "") -> Outcomes:
    """Fuse trials by the rows whose names start with `only`.

    Returns
    -------
    {row/lost: which targets are lost, (R, 5) of 0 and 1; row/far: mass far from all targets, (R,);
    with all sensors, row/missed: how many missed each, (R, 5); row/mixed: whether two became one, (R,)}
    """
    parts, seen = trials(runs, seed)
    missed = (~seen).sum(1).astype(float)

    def measure(row: str) -> Outcomes:
        kept = ROWS[row](parts)
        columns = {"lost": kept.lost.astype(float), "far": kept.far}
        return columns if "sensors" in row else columns | {"missed": missed, "mixed": kept.mixed.astype(float)}

    return row_by_row({row: row for row in chosen(ROWS, only)}, progress, measure)


def figures(outcomes: Outcomes) -> dict[str, Estimate]:
    """Lost targets a trial, mass of false alarms; how often a target is lost that so many sensors missed."""
    measured: dict[str, Estimate] = {}
    for row in ROWS:
        if f"{row}/lost" not in outcomes:
            continue
        lost = outcomes[f"{row}/lost"]
        measured[f"{row}/lost_targets_1"] = Estimate.mean(lost.sum(-1))
        measured[f"{row}/far_mass_1"] = Estimate.mean(outcomes[f"{row}/far"])
        if f"{row}/missed" not in outcomes:
            continue
        measured[f"{row}/mixed_share_1"] = Estimate.share(outcomes[f"{row}/mixed"])
        for k, target in enumerate(TARGETS):
            measured[f"{row}/lost_at_{target:.0f}_share_1"] = Estimate.share(lost[:, k])
        for count in range(3):
            measured |= _lost_share(row, lost, outcomes[f"{row}/missed"] == count, count)
    return measured


def _lost_share(row: str, lost: Array, cases: NDArray[np.bool_], count: int) -> dict[str, Estimate]:
    """Share of the targets that `count` sensors missed which are lost; a ratio of averages over trials."""
    if cases.any(-1).sum() < 2:  # leaving the only trial out would leave no case
        return {}
    both = np.stack([(lost * cases).sum(-1), cases.sum(-1)], -1)
    return {f"{row}/lost_missed_by_{count}_share_1": Estimate.of_averages(both, lambda m: m[:, 0] / m[:, 1])}


def scores(rules: Sequence[RuleChoice], runs: Sequence[int], seed: int, progress: Progress) -> Outcomes:
    """Lost targets and mass far from all targets of any rules, each scaled to the mean number of targets, (R,)."""
    parts, _ = trials(runs, seed)

    def measure(choice: RuleChoice) -> Outcomes:
        kept = by_rule(choice)(parts)
        return {"lost_targets_1": kept.lost.sum(-1).astype(float), "far_mass_1": kept.far}

    return rule_by_rule("given", rules, progress, measure)


# Charts and claims.


def charts(outcomes: Outcomes) -> list[Chart]:
    """Fig. 8 for the first trial of seed 0; lost targets by the number of sensors and by target."""
    measured = figures(outcomes)
    labels = {AA: "arithmetic", GA: "geometric", EXACT: "geometric, exact"}
    rows = {row: label for row, label in labels.items() if f"{row}/lost_targets_1" in measured}
    panels = [_trial_chart(rows)] if rows else []
    lines = []
    for row, label in labels.items():
        names = {k: f"{row}@sensors{k}/lost_targets_1" for k in range(2, SENSORS)} | {6: f"{row}/lost_targets_1"}
        known = {k: measured[name] for k, name in names.items() if name in measured}
        if known:
            lines.append(estimates(label, known, "points" if row == EXACT else "line"))
    if lines:
        panels.append(Chart("Lost targets of five", "sensors", "targets a trial", tuple(lines)))
    if rows:
        bars = tuple(
            estimates(label, {k: measured[f"{row}/lost_at_{t:.0f}_share_1"] for k, t in enumerate(TARGETS)}, "bars")
            for row, label in rows.items()
        )
        ticks = {float(k): f"{t:.0f}" for k, t in enumerate(TARGETS)}
        panels.append(Chart("Lost by place of the target", "target at", "share of trials", bars, ticks=ticks))
    return panels


def _trial_chart(rows: Mapping[str, str]) -> Chart:
    parts, _ = trials([0], 0)
    lines = []
    for row, label in rows.items():
        choice = AVERAGE if row == AA else HYBRID
        values = exact_geometric(parts, X) if row == EXACT else intensity(fused_intensity(choice, parts), X)
        lines.append(Series(label, X, values[0], "dashed" if row == EXACT else "line"))
    used = parts.weight[0] > 0
    places, weights = parts.mean[0, ..., 0][used], parts.weight[0][used]
    lines.append(Series("components: weight / 50", places, weights / 50.0, "points"))
    lines.append(Series("targets", TARGETS, np.zeros(len(TARGETS)), "points"))
    return Chart("Fig. 8: one trial, six sensors", "x", "targets per unit of x", tuple(lines))


CLAIMS = (
    Claim.order("The geometric average loses targets that the arithmetic average keeps.", "5.2, Fig. 8",
                f"{AA}/lost_targets_1", f"{GA}/lost_targets_1"),
    Claim(
        "It mixes the targets at 20 and 40 (judged: in most trials), and the arithmetic average does not (in less than "
        "one of twenty).",
        "5.2, Fig. 8",
        (f"{GA}/mixed_share_1", f"{AA}/mixed_share_1"),
        lambda geometric, arithmetic: [geometric - 0.5, 0.05 - arithmetic],
    ),
    Claim.order("The more sensors, the more targets the geometric average loses.", "5.2; 6, PHD fusion, conclusion 2",
                *(f"{GA}@sensors{k}/lost_targets_1" for k in range(2, SENSORS)), f"{GA}/lost_targets_1"),
    Claim.above(
        "A target that one sensor misses is lost from the geometric average, whatever the other five see (judged: in "
        "more than nine of ten cases).", "5.2",
        0.9, f"{GA}/lost_missed_by_1_share_1",
    ),
    Claim.order("The geometric average suppresses false alarms better: less mass far from all targets.",
                "6, PHD fusion, conclusion 2", f"{GA}/far_mass_1", f"{AA}/far_mass_1"),
    Claim.order("Without the approximation (49) the geometric average loses fewer targets.", "5.2",
                f"{EXACT}/lost_targets_1", f"{GA}/lost_targets_1"),
)  # fmt: skip

SCENARIO = Scenario(
    key="li2019-six-sensors",
    title="Intensities of six sensors that miss targets",
    paper=f"{PAPER}, 5.2, Fig. 8",
    shows="how many of five targets the averages of six intensities lose, and what false alarms they keep",
    default_runs=200,
    publication_runs=1000,
    assumptions=(
        "assumed: components of variance 25, detections 2 (standard deviation) from their target, weights uniform from "
        "0.5 to 1, those of false alarms too",
        "assumed: a target is lost when the mass within 8 of it is less than half of the arithmetic average's median "
        "with all six sensors detecting (from 2000 trials of their own)",
        "assumed: the targets at 20 and 40 are mixed when the intensity at 30 exceeds that at both",
        "assumed: mass further than 15 from all targets is of false alarms",
        "assumed: a sensor that sees nothing at all, one in 270,000, looks again",
        "the geometric average takes its number of targets from the arithmetic average; it is brought down to 20 "
        "components after each sensor, by Runnalls' cost",
        "@exact: without the approximation (49), point by point; @sensorsK: the first K of the six",
        "compare: what a rule gives is scaled to the sources' mean number of targets",
    ),
    simulate=simulate,
    figures=figures,
    charts=charts,
    claims=CLAIMS,
    piece=50,
    rules=(AVERAGE, HYBRID),
    scores=scores,
)
