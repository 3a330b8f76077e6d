"""Chen and Zhou 2022, section 5.2: a target on a line, heavy-tailed noises, robust filters and fusion with feedback.

Everything is in covariances: with kappa = dof / (dof - 2) of t(3), a nominal Q, R or P(0|0) of the paper, which is a
scatter, stands here as kappa times itself, and so does every state. Setting the dof of a posterior back to 3 by moment
matching, and feeding back a fused scatter, then change no number.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from track_fusion.filters.gaussian_student_t_mixture import GaussianStudentTMixture
from track_fusion.filters.student_t import StudentT, StudentTParams
from track_fusion.linalg import Array
from track_fusion.metrics.accuracy import Estimate, armse, rmse
from track_fusion.models.measurement import LinearSensor
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.models.noise import Noise
from track_fusion.rules import FusedTracks
from track_fusion.scenarios.chen2022 import PAPER, choices
from track_fusion.study.chart import Chart, Series
from track_fusion.study.claim import Claim
from track_fusion.study.one_target import drawn, fused_row, same_filters
from track_fusion.study.rows import Outcomes, Progress, chosen
from track_fusion.study.rule_choice import RuleChoice
from track_fusion.study.scenario import Scenario
from track_fusion.study.scene import Tracking
from track_fusion.tracks import StateLayout

#: Degrees of freedom of all densities, and covariance over scatter.
DOF = 3.0
KAPPA = DOF / (DOF - 2.0)
#: (69)-(71): one draw in ten has this many times the variance. The sensors' (u) depends on the filter studied.
OUTLIER_SHARE, PROCESS_OUTLIERS = 0.1, 200.0
MEASUREMENT_OUTLIERS = {"stf": 200.0, "gstm": 100.0}

LAYOUT = StateLayout(("x", "vx"))


def linear_sensor(axes: tuple[str, ...], scatter: list[list[float]]) -> LinearSensor:
    """Make a sensor of these axes whose noise has the nominal scatter R of the paper."""
    return LinearSensor(axes, np.eye(LAYOUT.size)[list(LAYOUT.indices(axes))], KAPPA * np.array(scatter))


#: (72), (74). Sensor 2 sees the velocity alone.
SENSOR_1, SENSOR_2 = linear_sensor(("x",), [[16.0]]), linear_sensor(("vx",), [[16.0]])
SENSOR_3 = linear_sensor(("x", "vx"), [[16.0, 4.0], [4.0, 6.0]])


def tracking(*sensors: LinearSensor) -> Tracking:
    """Make the scenario of so many sensors as the Student-t filter meets it."""
    return Tracking(
        motion=NearlyConstantVelocity(
            LAYOUT, MotionParams(noise_form="piecewise_constant", process_noise=float(np.sqrt(KAPPA)))
        ),
        dt_s=1.0,
        steps=100,
        initial_mean=np.array([0.0, 5.0]),
        initial_cov=KAPPA * np.diag([10.0, 25.0]),
        sensors={f"sensor_{i}": sensor for i, sensor in enumerate(sensors, 1)},
        process_noise=Noise(1.0 / KAPPA, OUTLIER_SHARE, PROCESS_OUTLIERS),
        measurement_noise=Noise(1.0 / KAPPA, OUTLIER_SHARE, MEASUREMENT_OUTLIERS["stf"]),
        initial_noise=Noise(1.0 / KAPPA),
    )


def for_filter(base: Tracking, name: str) -> Tracking:
    """Return the scenario as a filter meets it: only the outliers of the measurements differ."""
    noise = dataclasses.replace(base.measurement_noise, outlier_scale=MEASUREMENT_OUTLIERS[name])
    return dataclasses.replace(base, measurement_noise=noise)


#: The filters of Table 1. Both predict as the Kalman filter does; nominal matrices are scatters of t(3) in both.
FILTERS = {
    "stf": same_filters(StudentT(StudentTParams(dof=DOF))),
    "gstm": same_filters(GaussianStudentTMixture(dof=DOF)),
}

#: The rules of Table 1 in its order, and MHDP-E with the criterion as printed.
PRINTED = (choices.DCI, choices.GP, choices.FCI, choices.KLA, choices.QMMHD, choices.MHDP_E, choices.MHDP_I)
RULE_CHOICES = (*PRINTED, choices.UNSQUARED)
TABLE_1_RULES = DCI, GP, FCI, KLA, QMMHD, MHDP_E, MHDP_I = tuple(choice.name for choice in PRINTED)
#: What the paper calls those that are compared with MHDP.
SHORT = {DCI: "DCI", GP: "GP", FCI: "FCI", KLA: "KLA", QMMHD: "QMMHD"}
FIGURE, EXCESS = "position_armse_m", "position_excess_m"

ASSUMPTIONS = (
    "the truth starts at a draw from N(x(0|0), P(0|0))",
    "Q, R and P(0|0) are scatters of t(3) in the filters, and covariances of the Gaussian parts of the true noises",
    "the outliers of the process noise and of each sensor are independent; an outlier of sensor 3 hits both its axes",
    "sensor 2 sees the velocity alone: h = [0, 1]",
    "mean and scatter of the fused density are fed back to every sensor; the dof goes back to 3 by moment matching "
    "after each update",
    "MHDP and QMMHD fuse t(3) densities, GP Gaussians; DCI minimises the determinant, KLA weighs equally, FCI is the "
    "exact half-way point; QMMHD, whose equations are in another paper, is the intersection at the weights with the "
    "least sum of squared minimal Manhattan distances",
    "MHDP minimises the sum of squared distances; @unsquared: that of the distances, as printed",
    "the parameters of the mixture filter (gstm) are not in the paper: ordering only. Prediction and measurement noise "
    "are Gaussian with a probability of prior Beta(a, b), else t(3) with the same nominal matrix (variational Bayes); "
    "assumed: a = 0.85, b = 0.15; its posterior covariance is taken as the scatter of a t(3) density",
    "both filters meet the same truth and the same draws; the outliers of the sensors have 200 times the variance for "
    "the Student-t filter, 100 times for the mixture filter, as printed",
    "error: root-mean-square over runs at each step, averaged over the 100 steps; excess: that of a rule less that of "
    "MHDP-E; clearly: by more than three standard errors",
)


def fusions(base: Tracking, name: str, choice: RuleChoice, seed: int, runs: Sequence[int]) -> Iterator[FusedTracks]:
    """What a rule fuses at each step, fed back to one filter a sensor; mean (R, n), cov (R, n, n)."""
    met = for_filter(base, name)
    return fused_row(met, FILTERS[name], choice).estimates(drawn(met, runs, seed))


#: A row of Table 1: which filter, and the rule.
Row = tuple[str, RuleChoice]


def rows(rules: Sequence[RuleChoice]) -> dict[str, Row]:
    """Every rule with every filter."""
    return {f"{name}-{choice.name}": (name, choice) for name in FILTERS for choice in rules}


def squared_errors(
    base: Tracking, table: Mapping[str, Row], runs: Sequence[int], seed: int, progress: Progress
) -> Outcomes:
    """Squared position errors of every row, (R, T), over the same Monte Carlo runs."""
    truth = base.truths(seed, runs)[:, :, LAYOUT.position]
    squares = {row: np.empty((len(runs), base.steps)) for row in table}
    for done, (row, (name, choice)) in enumerate(table.items()):
        for k, fused in enumerate(fusions(base, name, choice, seed, runs)):
            squares[row][:, k] = ((fused.mean[:, LAYOUT.position] - truth[:, k + 1]) ** 2).sum(-1)
            progress((done + (k + 1) / base.steps) / len(table))
    return squares


def scores(base: Tracking, rules: Sequence[RuleChoice], runs: Sequence[int], seed: int, progress: Progress) -> Outcomes:
    """Root of the time-averaged squared position error of each run, (R,), under any rules, with both filters."""
    errors = squared_errors(base, rows(rules), runs, seed, progress)
    return {f"{row}/position_rmse_m": np.sqrt(squares.mean(1)) for row, squares in errors.items()}


def figures(outcomes: Outcomes) -> dict[str, Estimate]:
    """ARMSE of each row, and by how much it exceeds that of MHDP-E with the same filter, the runs being paired."""
    estimates = {f"{row}/{FIGURE}": armse(squares) for row, squares in outcomes.items()}
    for row, squares in outcomes.items():
        reference = f"{row.partition('-')[0]}-{MHDP_E}"
        if row != reference and reference in outcomes:
            pair = np.stack([squares, outcomes[reference]], -1)
            estimates[f"{row}/{EXCESS}"] = Estimate.of_averages(pair, _excess)
    return estimates


def _excess(mean: Array) -> Array:
    """ARMSE less that of the reference, from mean squares (L, T, 2)."""
    both = np.sqrt(mean.clip(0)).mean(1)
    return np.asarray(both[:, 0] - both[:, 1])


def charts(outcomes: Outcomes) -> list[Chart]:
    """Position RMSE over the steps, one chart a filter; DCI, far above, is left out as in Fig. 3."""
    panels = []
    for name in FILTERS:
        lines = {row: squares for row, squares in outcomes.items() if row.startswith(f"{name}-")}
        series = [
            Series(row.partition("-")[2], np.arange(1, squares.shape[1] + 1), rmse(squares))
            for row, squares in lines.items()
            if row != f"{name}-{DCI}" or len(lines) == 1
        ]
        if series:
            panels.append(Chart(f"{name.upper()}: position RMSE", "step", "RMSE / m", tuple(series)))
    return panels


def claims(name: str, printed: Mapping[str, float]) -> list[Claim]:
    """What section 5.2 says of the rules, for one filter, and which rule its printed column puts behind MHDP."""
    label = {"stf": "Student-t filter", "gstm": "Gaussian-Student-t-mixture filter"}[name]

    def needs(*rules: str) -> tuple[str, ...]:
        return tuple(f"{name}-{rule}/{FIGURE}" for rule in rules)

    others = (DCI, GP, FCI, KLA, QMMHD)
    second, *rest = sorted(others[1:], key=printed.__getitem__)
    statements = [
        Claim.above(f"{label}: MHDP-E has clearly lower errors than DCI, GP, FCI, KLA and QMMHD",
                    "5.2, Fig. 3, Table 1", 0.0, *(f"{name}-{rule}/{EXCESS}" for rule in others)),
        Claim.least(f"{label}: {SHORT[second]} comes next, before {', '.join(SHORT[rule] for rule in rest)}",
                    "Table 1", needs(second)[0], needs(*rest)),
        Claim.greatest(f"{label}: DCI is the worst", "5.2", needs(DCI)[0], needs(*TABLE_1_RULES[1:])),
    ]  # fmt: skip
    if name == "gstm":
        text = f"{label}: MHDP-I is slightly, but clearly better than MHDP-E"
        statements.append(Claim.below(text, "5.2", 0.0, f"{name}-{MHDP_I}/{EXCESS}"))
    return statements


def scenario(key: str, title: str, base: Tracking, table: Mapping[str, Sequence[float]], runs: int) -> Scenario:
    """Make the scenario of one case.

    Parameters
    ----------
    base : Tracking      as the Student-t filter meets it
    table : mapping      filter -> position ARMSE as printed in Table 1, by TABLE_1_RULES
    runs : int           for a quick look
    """
    columns = {name: dict(zip(TABLE_1_RULES, values, strict=True)) for name, values in table.items()}
    return Scenario(
        key=key,
        title=title,
        paper=f"{PAPER}, 5.2",
        shows="rules that see heavy-tailed densities beside rules that see moments, when outliers disturb motion and "
        "measurements and the fused posterior is fed back to robust filters",
        published={
            f"{name}-{rule}/{FIGURE}": value for name, column in columns.items() for rule, value in column.items()
        },
        published_runs=500,
        default_runs=runs,
        publication_runs=500,
        assumptions=ASSUMPTIONS,
        simulate=lambda runs, seed, progress, only: squared_errors(
            base, chosen(rows(RULE_CHOICES), only), runs, seed, progress
        ),
        figures=figures,
        charts=charts,
        claims=tuple(claim for name, column in columns.items() for claim in claims(name, column)),
        piece=50,
        tracking=base,
        rules=RULE_CHOICES,
        scores=partial(scores, base),
    )
