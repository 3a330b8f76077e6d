"""Ahmed, Gaussian-mixture DDF, 5.4: a manoeuvring target, three platforms that see ranges only, news once a minute."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from track_fusion.filters.gaussian_sum_modes import MixtureModes
from track_fusion.linalg import Array
from track_fusion.metrics.accuracy import Estimate, rmse
from track_fusion.peers import Fuse, Peer
from track_fusion.rules.mixture_wep import MixtureWepParams
from track_fusion.scenarios.ahmed import PAPER
from track_fusion.scenarios.ahmed.platforms import (
    COMPONENTS,
    PLATFORMS,
    POSITION,
    SCHEDULE,
    STEPS,
    VELOCITY,
    Platforms,
    centralised,
    follow,
    fuse_modes,
    measurements,
    prior,
    truths,
)
from track_fusion.study.chart import Chart, Series, ellipse
from track_fusion.study.claim import Claim
from track_fusion.study.rows import Outcomes, Progress, chosen
from track_fusion.study.rule_choice import RuleChoice
from track_fusion.study.scenario import Scenario

#: As the paper has it, omega is sought on one set of samples, whatever its error.
IGS = MixtureWepParams(
    criterion="minimax_information_loss", method="igs", samples=1000, max_components=COMPONENTS, omega_error=1.0
)
RULE_CHOICES = (
    RuleChoice("mixture_wep", IGS),
    RuleChoice("mixture_wep", dataclasses.replace(IGS, method="foci"), "foci"),
)
CENTRE, ALONE, BY_IGS, BY_FOCI = "gsf-ic", "gsf-alone", "gsf-mixture_wep", "gsf-mixture_wep@foci"
#: When the components of the platforms' densities are kept for a picture: the third fusion.
PICTURED = 3 * SCHEDULE.period
TWO_SIGMA = 2.0
#: Of the points around an ellipse every so many-th is drawn: there are many ellipses.
AROUND_STEP = 3


def simulate(runs: Sequence[int], seed: int, progress: Progress, only: str = "", steps: int = STEPS) -> Outcomes:
    """Track with every row: errors and variances, arrays by row.

    Returns
    -------
    truth (R, T + 1, 4); for each row, of P = 3 platforms (centralised: 1), K fusions: `error` and `variance`
    (R, P, T, 4) of the state after any fusion, `before` (R, P, K, 4) variances just before the fusions, `components`
    (R, P, 60, 6) at step 180: weight, x, y and the covariance xx, xy, yy
    """
    table = {f"gsf-{choice.name}": choice for choice in RULE_CHOICES}
    rows = list(chosen(dict.fromkeys((CENTRE, ALONE, *table)), only))
    study = Study(runs, seed, steps, progress, len(rows))
    outcomes = {"truth": study.truth}
    for row in rows:
        if row == CENTRE:
            columns = study.centralised()
        else:
            columns = study.platforms(fuse_modes(table[row], seed) if row in table else None)
        outcomes |= {f"{row} {name}": values for name, values in columns.items()}
    return outcomes


class Study:
    """Some Monte Carlo runs: what happens and is seen in them, and one row after the other.

    Parameters
    ----------
    runs, seed, steps
    progress, rows       where to tell how much of so many rows is done
    """

    def __init__(self, runs: Sequence[int], seed: int, steps: int, progress: Progress, rows: int) -> None:
        self.truth, self.steps = truths(runs, seed, steps), steps
        self._progress, self._rows, self._done = progress, rows, 0
        self.seen, self.start = measurements(self.truth, runs, seed), prior(runs, seed)
        self._common: tuple[Platforms, Record] | None = None

    def centralised(self) -> Outcomes:
        """Run the filter that sees everything."""
        record = Record(self.truth, 1)
        for step, modes in enumerate(centralised(self.start, self.seen, self.steps), 1):
            record.estimate(step, [modes.moments])
            self._tell(step)
        self._done += 1
        return record.outcomes

    def platforms(self, fuse: Fuse[MixtureModes] | None) -> Outcomes:
        """Run the platforms, which fuse what they hear in some way, or never talk."""
        first = SCHEDULE.period - 1
        if self._common is None:
            self._common = self._follow({name: Peer(self.start) for name in PLATFORMS}, 1, first, None, None)
        platforms, record = self._common  # nobody has talked yet
        _, record = self._follow(platforms, first + 1, self.steps, fuse, record)
        self._done += 1
        return record.outcomes

    def _follow(
        self, platforms: Platforms, begin: int, end: int, fuse: Fuse[MixtureModes] | None, known: Record | None
    ) -> tuple[Platforms, Record]:
        record = Record(self.truth, len(platforms)) if known is None else copy.deepcopy(known)
        steps, after = range(begin, min(end, self.steps) + 1), platforms
        for step, (before, after) in zip(steps, follow(platforms, self.seen, steps, fuse), strict=True):
            record.estimate(step, [peer.density.moments for peer in after.values()])
            if SCHEDULE.at(step):
                record.fusion(step, [peer.density.moments[1] for peer in before.values()])
            if step == PICTURED:
                record.picture([peer.density for peer in after.values()])
            self._tell(step)
        return after, record

    def _tell(self, step: int) -> None:
        self._progress((self._done + step / self.steps) / self._rows)


class Record:
    """Errors, variances and components of P platforms, as :func:`simulate` returns them."""

    def __init__(self, truth: Array, platforms: int) -> None:
        runs, count, n = truth.shape
        self._truth = truth
        shape = (runs, platforms, count - 1, n)
        self.outcomes: Outcomes = {
            "error": np.empty(shape),
            "variance": np.empty(shape),
            "before": np.zeros((runs, platforms, (count - 1) // SCHEDULE.period, n)),
            "components": np.zeros((runs, platforms, 0 if count <= PICTURED else 5 * COMPONENTS, 6)),
        }

    def estimate(self, step: int, moments: Sequence[tuple[Array, Array]]) -> None:
        """Keep the moments (R, n), (R, n, n) of each platform."""
        for p, (mean, cov) in enumerate(moments):
            self.outcomes["error"][:, p, step - 1] = mean - self._truth[:, step]
            self.outcomes["variance"][:, p, step - 1] = np.diagonal(cov, axis1=-2, axis2=-1)

    def fusion(self, step: int, covs: Sequence[Array]) -> None:
        """Keep the variances that each platform had before it fused."""
        for p, cov in enumerate(covs):
            self.outcomes["before"][:, p, step // SCHEDULE.period - 1] = np.diagonal(cov, axis1=-2, axis2=-1)

    def picture(self, densities: Sequence[MixtureModes]) -> None:
        """Keep the positions of each platform's components over all modes."""
        x, y = POSITION
        for p, density in enumerate(densities):
            part = density.marginal
            columns = (part.weight, part.mean[..., x], part.mean[..., y],
                       part.cov[..., x, x], part.cov[..., x, y], part.cov[..., y, y])  # fmt: skip
            self.outcomes["components"][:, p, : part.count] = np.stack(columns, -1)


# Figures.


def norms(outcomes: Outcomes, row: str, axes: Sequence[int]) -> Array:
    """Norm of the error over some axes, (R, P, T)."""
    return np.asarray(np.sqrt((outcomes[f"{row} error"][..., axes] ** 2).sum(-1)))


def bounds(outcomes: Outcomes, row: str, axes: Sequence[int], name: str = "variance") -> Array:
    """Two-sigma bound over some axes, (R, P, T): twice the root of the trace."""
    return np.asarray(TWO_SIGMA * np.sqrt(outcomes[f"{row} {name}"][..., axes].sum(-1)))


def fusions(values: Array) -> Array:
    """Pick the steps at which platforms fuse: (..., T) -> (..., K)."""
    return values[..., SCHEDULE.period - 1 :: SCHEDULE.period]


def rows_of(outcomes: Outcomes) -> list[str]:
    """List the rows that were run."""
    return [name.removesuffix(" error") for name in outcomes if name.endswith(" error")]


def run_medians(values: Array) -> Estimate:
    """Median over runs of each run's median over all else."""
    return Estimate.median(np.median(values.reshape(len(values), -1), 1))


def run_means(values: Array | NDArray[np.bool_]) -> Estimate:
    """Mean over runs of each run's mean (share, if true or false) over all else."""
    return Estimate.mean(values.reshape(len(values), -1).mean(1))


def figures(outcomes: Outcomes) -> dict[str, Estimate]:
    """Errors right after the fusions and over all steps, how they scatter, what is claimed of them."""
    estimates: dict[str, Estimate] = {}
    for row in rows_of(outcomes):
        position, velocity = norms(outcomes, row, POSITION), norms(outcomes, row, VELOCITY)
        at_fusions = fusions(position)
        estimates[f"{row}/median_position_error_m"] = run_medians(at_fusions)
        estimates[f"{row}/median_velocity_error_mps"] = run_medians(fusions(velocity))
        if position.shape[1] > 1:
            for p, name in enumerate(PLATFORMS):
                estimates[f"{row}/median_position_error_p{name}_m"] = run_medians(at_fusions[:, p])
        estimates[f"{row}/median_position_error_all_steps_m"] = run_medians(position)
        estimates[f"{row}/median_velocity_error_all_steps_mps"] = run_medians(velocity)
        estimates[f"{row}/share_inside_2_sigma_1"] = run_means(position < bounds(outcomes, row, POSITION))
        estimates |= _of_fusion(outcomes, row)
    return estimates


def _of_fusion(outcomes: Outcomes, row: str) -> dict[str, Estimate]:
    """Compare a row with the centralised one, with itself before the fusions, and with IGS at platform 2."""
    estimates: dict[str, Estimate] = {}
    if row in (CENTRE, ALONE):
        return estimates
    bound = bounds(outcomes, row, POSITION)
    shrunk = fusions(bound) < bounds(outcomes, row, POSITION, "before")
    estimates[f"{row}/share_of_fusions_that_shrink_2_sigma_1"] = run_means(shrunk)
    error = np.log10(fusions(norms(outcomes, row, POSITION))[:, 1])
    if error.shape[1] > 1:
        estimates[f"{row}/log10_position_error_sd_p2_1"] = Estimate.mean(error.std(1, ddof=1))
    if f"{CENTRE} error" in outcomes:
        above = bound > bounds(outcomes, CENTRE, POSITION)
        estimates[f"{row}/share_of_steps_above_centralised_2_sigma_1"] = run_means(above)
    if row != BY_IGS and f"{BY_IGS} error" in outcomes:
        reference = np.log10(fusions(norms(outcomes, BY_IGS, POSITION))[:, 1])
        estimates[f"{row}/log10_error_ratio_to_igs_p2_1"] = run_means(error - reference)
    return estimates


def scores(rules: Sequence[RuleChoice], runs: Sequence[int], seed: int, progress: Progress) -> Outcomes:
    """Median position error over platforms and fusions, in metres, of each run (R,), for any rule for two tracks."""
    ways: dict[str, Fuse[MixtureModes]] = {f"gsf-{choice.name}": fuse_modes(choice, seed) for choice in rules}
    study, errors_m = Study(runs, seed, STEPS, progress, len(ways)), {}
    for row, fuse in ways.items():
        errors = {f"{row} {name}": values for name, values in study.platforms(fuse).items()}
        at_fusions = fusions(norms(errors, row, POSITION))
        errors_m[f"{row}/median_position_error_m"] = np.median(at_fusions.reshape(len(runs), -1), 1)
    return errors_m


# Pictures.

LABELS = {CENTRE: "centralised", ALONE: "independent", BY_FOCI: "FOCI", BY_IGS: "IGS"}


def charts(outcomes: Outcomes) -> list[Chart]:
    """Redraw Figs. 10 to 15: ways, densities at step 180, errors with bounds over time, distributions."""
    rows = rows_of(outcomes)
    panels = [_map(outcomes["truth"][0])]
    panels += [_components(outcomes, row) for row in rows if outcomes[f"{row} components"][0].any()]
    for p, name in enumerate(PLATFORMS):
        panels.append(_over_time(outcomes, rows, p, f"Platform {name}: position RMSE and 2-sigma bound", POSITION, "m"))
    panels.append(_over_time(outcomes, rows, 1, "Platform 2: velocity RMSE and 2-sigma bound", VELOCITY, "m/s"))
    for axis, label in ((POSITION[0], "east position error, m"), (VELOCITY[0], "east velocity error, m/s")):
        panels.append(_distribution(outcomes, rows, axis, label))
    return panels


def _map(truth: Array) -> Chart:
    places = np.array(list(PLATFORMS.values())) / 1e3
    lines = (
        Series("target, first run", truth[:, POSITION[0]] / 1e3, truth[:, POSITION[1]] / 1e3),
        Series("platforms", places[:, 0], places[:, 1], "points"),
    )
    return Chart("Target and platforms", "east, km", "north, km", lines, equal=True)


def _components(outcomes: Outcomes, row: str) -> Chart:
    """Two-sigma ellipses of each platform's components that have a share of 1e-3 or more, first run."""
    lines = []
    for name, parts in zip(PLATFORMS, outcomes[f"{row} components"][0], strict=True):
        heavy = parts[parts[:, 0] >= 1e-3]
        around = [ellipse("", c[1:3] / 1e3, c[[[3, 4], [4, 5]]] / 1e6, TWO_SIGMA) for c in heavy]
        x = np.concatenate([np.append(e.x[::AROUND_STEP], e.x[0]) for e in around])
        y = np.concatenate([np.append(e.y[::AROUND_STEP], np.nan) for e in around])  # NaN interrupts the line
        lines.append(Series(f"platform {name}", x, y))
    target = outcomes["truth"][0, PICTURED] / 1e3
    lines.append(Series("target", target[[POSITION[0]]], target[[POSITION[1]]], "points"))
    title = f"{LABELS[row]}: components at step {PICTURED}, 2 sigma"
    return Chart(title, "east, km", "north, km", tuple(lines), equal=True)


def _over_time(outcomes: Outcomes, rows: Iterable[str], p: int, title: str, axes: Sequence[int], unit: str) -> Chart:
    lines = []
    for row in rows:
        error, bound = norms(outcomes, row, axes), bounds(outcomes, row, axes)
        at, steps = min(p, error.shape[1] - 1), np.arange(1, error.shape[2] + 1)
        lines.append(Series(LABELS[row], steps, rmse(error[:, at] ** 2)))
        if row in (BY_FOCI, BY_IGS):
            lines.append(Series(f"{LABELS[row]}, 2 sigma", steps, bound[:, at].mean(0), "dashed"))
    return Chart(title, "time, s", unit, tuple(lines), log_y=True)


def _distribution(outcomes: Outcomes, rows: Iterable[str], axis: int, label: str) -> Chart:
    """Shares of runs and fusions with an error of platform 2 below x, right after the fusions."""
    lines = []
    for row in rows:
        error = np.abs(outcomes[f"{row} error"][..., axis])
        values = np.sort(fusions(error[:, min(1, error.shape[1] - 1)]).ravel())
        lines.append(Series(LABELS[row], values, np.arange(1, len(values) + 1) / len(values), "steps"))
    return Chart(f"Platform 2 after fusions: {label.partition(',')[0]}", label, "share below", tuple(lines), log_x=True)


CLAIMS = (
    Claim.order(
        "right after the fusions IGS lies between the centralised filter and FOCI, and FOCI below independent filters",
        "5.4.3, Fig. 14", *(f"{row}/median_position_error_m" for row in (CENTRE, BY_IGS, BY_FOCI, ALONE)),
    ),
    Claim.above(
        "position errors of FOCI at platform 2 right after the fusions are one or two orders of magnitude larger than "
        "those of IGS (judged: mean ratio at least tenfold)", "5.4.3, Fig. 15",
        1.0, f"{BY_FOCI}/log10_error_ratio_to_igs_p2_1",
    ),
    Claim.order(
        "errors of FOCI at platform 2 vary more than those of IGS (judged: standard deviation of the logarithm from "
        "fusion to fusion, any more)", "5.4.3, Fig. 15",
        f"{BY_IGS}/log10_position_error_sd_p2_1", f"{BY_FOCI}/log10_position_error_sd_p2_1",
    ),
    Claim("position errors of IGS are generally in the tens of metres, velocity errors in single digits "
          "(judged: medians over all steps below 100 m and 10 m/s)", "5.4.3, Fig. 14",
          (f"{BY_IGS}/median_position_error_all_steps_m", f"{BY_IGS}/median_velocity_error_all_steps_mps"),
          lambda position, velocity: [100.0 - position, 10.0 - velocity]),
    Claim.above("the 2-sigma bound of IGS drops at each fusion (judged: at 19 of 20)", "5.4.3, Fig. 14",
                0.95, f"{BY_IGS}/share_of_fusions_that_shrink_2_sigma_1"),
    Claim.above(
        "IGS and FOCI remain conservative relative to the centralised filter in all instances (judged: their 2-sigma "
        "bounds are wider at 99 of 100 steps)", "5.4.3, Fig. 14",
        0.99, *(f"{row}/share_of_steps_above_centralised_2_sigma_1" for row in (BY_IGS, BY_FOCI)),
    ),
    Claim.above(
        "IGS and FOCI are statistically consistent (judged: at least 95 % of position errors inside the 2-sigma bound)",
        "5.4.3, Fig. 14",
        0.95,
        *(f"{row}/share_inside_2_sigma_1" for row in (BY_IGS, BY_FOCI)),
    ),
)  # fmt: skip


SCENARIO = Scenario(
    key="ahmed-maneuver",
    title="A manoeuvring target, three platforms that see ranges and talk once a minute around a ring",
    paper=f"{PAPER}, 5.4",
    shows="what the weighted exponential product keeps of mixtures far from Gaussian when sampled (IGS) and by FOCI",
    published_runs=50,
    default_runs=5,
    publication_runs=10,
    assumptions=(
        "assumed: platforms at (0, -10), (15, 10) and (-15, 10) km",
        "assumed: the first mode is uniform, for the truth and for the filters",
        "the twelve components of each mode at the start are drawn once a run and are the same for all platforms",
        "process noise: 2 is the power spectral density in m^2/s^3 of the acceleration of each axis, by van Loan",
        "the target moves by the old mode, then jumps, in the truth as in the filters: (57), (73)",
        "all platforms fuse what the others held before the round; the fusion at step 420 is the last",
        "omega and the integrals eta by Algorithm 1 with 1000 samples, for FOCI too; a platform's mode probabilities "
        "count its own times eta, (76)",
        "samples of the fusions are drawn from a stream for each message of a platform, the same in every run",
        "components below 1e-12 of a mode's weight are dropped before Runnalls' merging",
        "the centralised filter keeps one Gaussian a mode and takes the platforms' measurements one after the other",
        "the 2-sigma bound is twice the root of the trace of the position's or velocity's covariance",
        "figures are medians over runs: root-mean-square errors over all time are dominated by outliers",
    ),
    simulate=simulate,
    figures=figures,
    charts=charts,
    claims=CLAIMS,
    piece=1,
    rules=RULE_CHOICES,
    scores=scores,
)
