"""Sharma et al., section 6.1, Fig. 3: which weights the rules find for scalars, and what becomes of the estimate."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from track_fusion.linalg import Array
from track_fusion.metrics.accuracy import Estimate, armse
from track_fusion.random_streams import stream
from track_fusion.rules import RULES
from track_fusion.scenarios.sharma import PAPER
from track_fusion.study.chart import Chart, Series, bars
from track_fusion.study.claim import Claim, within
from track_fusion.study.rows import Outcomes, Progress, chosen, row_by_row
from track_fusion.study.rule_choice import RuleChoice, fuse_runs, rule_by_rule
from track_fusion.study.scenario import Scenario

STEPS = 100


class Setting(NamedTuple):
    """Variance of the process noise in units of the measurement's, and the correlation of both."""

    ratio: float
    correlation: float

    @property
    def name(self) -> str:
        """Such as q0_1_rho0_5."""
        return f"q{self.ratio:g}_rho{self.correlation:g}".replace(".", "_").replace("-", "_minus_")


#: The paper gives neither noise variances nor the correlation.
SETTINGS = tuple(Setting(q, rho) for q in (0.1, 1.0, 10.0) for rho in (-0.5, 0.0, 0.5))
RULE_CHOICES = (
    RuleChoice.of("covariance_intersection"),
    RuleChoice.of("inverse_covariance_intersection"),
    RuleChoice.of("harmonic_mean"),
)


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two scalar tracks, each consistent, their errors correlated: variances, correlation, and how they are fused."""

    variances: tuple[float, float]
    correlation: float
    choice: RuleChoice


#: Whether HMD-GA is consistent: at the weights of (77), and at 1/2 near perfect correlation.
PAIRS = {
    "given-harmonic_mean@ratio10_rho0_9": Pair((1.0, 10.0), 0.9, RULE_CHOICES[-1]),
    "given-harmonic_mean@half_ratio10_rho0_99": Pair(
        (1.0, 10.0), 0.99, RuleChoice.of("harmonic_mean", criterion="given", weights=(0.5, 0.5))
    ),
}
#: Pairs drawn in each run.
DRAWS = 400


def correlated(normals: Array, deviations: Sequence[float], correlation: float) -> tuple[Array, Array]:
    """Turn independent standard normals (..., 2) into two numbers (...) of these deviations and correlation."""
    second = correlation * normals[..., 0] + np.sqrt(1.0 - correlation**2) * normals[..., 1]
    return deviations[0] * normals[..., 0], deviations[1] * second


#: A generator a run, for rules that sample.
Generators = Sequence[np.random.Generator]


def fuse(
    choice: RuleChoice, mean: Array, variance: Array, rngs: Generators | None = None
) -> tuple[Array, Array, Array]:
    """Fuse scalar tracks, mean and variance (R, 2): mean, variance and weight omega (R,), NaN where it has none."""
    fused = fuse_runs(choice, mean[..., None], variance[..., None, None], rngs)
    weight = np.full(len(mean), np.nan) if fused.weights is None else fused.weights[:, 0]
    return fused.mean[:, 0], fused.cov[:, 0, 0], weight


class Track(NamedTuple):
    """An estimate over the steps, (R, T): squared error, that over the claimed variance, weight omega."""

    square: Array
    nees: Array
    weight: Array


def track(setting: Setting, choice: RuleChoice | None, normals: Array, rngs: Generators | None = None) -> Track:
    """Fuse prior and measurement at steps 1 to T; without a rule take the measurement.

    Parameters
    ----------
    normals : (R, T + 1, 2)    standard; the first estimate is the measurement of step 0
    rngs                       a generator a run, for a rule that samples
    """
    process, noise = correlated(normals, (np.sqrt(setting.ratio), 1.0), setting.correlation)
    truth = np.cumsum(process, 1)
    z = truth + noise
    course = Track(*(np.empty((len(z), z.shape[1] - 1)) for _ in Track._fields))
    estimate, variance, one = z[:, 0], np.ones(len(z)), np.ones(len(z))
    for k in range(1, z.shape[1]):
        if choice is None:
            estimate, variance, weight = z[:, k], one, 0.0 * one
        else:
            pair = np.stack([estimate, z[:, k]], 1), np.stack([variance + setting.ratio, one], 1)
            estimate, variance, weight = fuse(choice, *pair, rngs)
        square = (estimate - truth[:, k]) ** 2
        for values, value in zip(course, (square, square / variance, weight), strict=True):
            values[:, k - 1] = value
    return course


@dataclasses.dataclass(frozen=True)
class Row:
    """A setting, and the rule that fuses there; None = the measurement alone."""

    setting: Setting
    choice: RuleChoice | None


def _rows() -> dict[str, Row | Pair]:
    """Each rule, and the measurement alone, in each setting; then the pairs."""
    choices: dict[str, RuleChoice | None] = {"alone": None}
    choices |= {choice.name: choice for choice in RULE_CHOICES}
    rows = {f"kf-{name}@{setting.name}": Row(setting, c) for name, c in choices.items() for setting in SETTINGS}
    return {**rows, **PAIRS}


ROWS = _rows()


def simulate(runs: Sequence[int], seed: int, progress: Progress, only: str = "") -> Outcomes:
    """Run the rows whose names start with `only`.

    Returns
    -------
    {row/square, row/nees, row/weight: (R, T)}, and of given pairs {row/nees: (R,)}
    """
    normals = _normals(runs, seed)

    def measure(row: Row | Pair) -> Outcomes:
        if isinstance(row, Pair):
            return {"nees": _pair_nees(row, runs, seed)}
        return track(row.setting, row.choice, normals)._asdict()

    return row_by_row(chosen(ROWS, only), progress, measure)


def _normals(runs: Sequence[int], seed: int) -> Array:
    return np.stack([stream(seed, run, "noise").standard_normal((STEPS + 1, 2)) for run in runs])


def _pair_nees(pair: Pair, runs: Sequence[int], seed: int) -> Array:
    """Average over the pairs drawn in each run, (R,)."""
    normals = np.stack([stream(seed, run, "pairs").standard_normal((DRAWS, 2)) for run in runs])
    errors = np.stack(correlated(normals.reshape(-1, 2), np.sqrt(pair.variances).tolist(), pair.correlation), 1)
    mean, variance, _ = fuse(pair.choice, errors, np.broadcast_to(pair.variances, errors.shape))
    return np.asarray((mean**2 / variance).reshape(len(runs), DRAWS).mean(1))


def figures(outcomes: Outcomes) -> dict[str, Estimate]:
    """Weight, averaged over steps and runs; root-mean-square error, averaged over steps; NEES."""
    measured = {}
    for name, values in outcomes.items():
        row, _, column = name.rpartition("/")
        if column == "square":
            measured[f"{row}/armse_1"] = armse(values)
        elif column == "nees" or not row.startswith("kf-alone"):
            measured[f"{row}/{column}_1"] = Estimate.mean(values.reshape(len(values), -1).mean(1))
    return measured


def charts(outcomes: Outcomes) -> list[Chart]:
    """Fig. 3 for each ratio of the noises: weights over the steps, averaged over runs; error and NEES by setting."""
    panels = []
    for ratio in dict.fromkeys(s.ratio for s in SETTINGS):
        lines = []
        for setting in (s for s in SETTINGS if s.ratio == ratio):
            for choice in RULE_CHOICES:
                name = f"kf-{choice.name}@{setting.name}/weight"
                # Where all correlations give the same line, one is enough.
                if name in outcomes and (choice.key == "harmonic_mean" or setting.correlation == 0.0):
                    lines.append(_weights(choice, setting, outcomes[name]))
        if lines:
            panels.append(Chart(f"Weights of the prior, q = {ratio:g} r", "step", "weight omega", tuple(lines)))
    return panels + _bars(outcomes)


def _weights(choice: RuleChoice, setting: Setting, values: Array) -> Series:
    harmonic = choice.key == "harmonic_mean"
    label = f"HMD-GA, rho {setting.correlation:g}" if harmonic else RULES[choice.key].title
    return Series(label, np.arange(1.0, values.shape[1] + 1), values.mean(0), "line" if harmonic else "dashed")


def _bars(outcomes: Outcomes) -> list[Chart]:
    """NEES of HMD-GA by setting."""
    values = {
        name.rpartition("@")[2].removesuffix("/nees_1"): estimate
        for name, estimate in figures(outcomes).items()
        if name.endswith("/nees_1") and "harmonic_mean" in name
    }
    return [bars("HMD-GA: squared error over the claimed variance", "NEES", values, "consistent")] if values else []


def scores(rules: Sequence[RuleChoice], runs: Sequence[int], seed: int, progress: Progress) -> Outcomes:
    """Run any rules in every setting: root of the squared error averaged over the steps, and NEES likewise, (R,)."""
    normals = _normals(runs, seed)

    def measure(choice: RuleChoice) -> Outcomes:
        of_run = {}
        for setting in SETTINGS:
            rngs = [stream(seed, run, "rule") for run in runs]
            tracked = track(setting, choice, normals, rngs)
            of_run[f"rmse_{setting.name}_1"] = np.sqrt(tracked.square.mean(1))
            of_run[f"consistency_{setting.name}_1"] = tracked.nees.mean(1)
        return of_run

    return rule_by_rule("kf", rules, progress, measure)


def _names(row: str, quantity: str) -> tuple[str, ...]:
    return tuple(f"kf-{row}@{setting.name}/{quantity}" for setting in SETTINGS)


def _same(error: Array, other: Array) -> tuple[Array, Array]:
    return within(error - other, TIE * other)


def _somewhere_a_fifth(*weights: Array) -> list[Array]:
    return [np.max([0.05 - np.abs(weight - 0.2) for weight in weights], 0)]


#: What is equal but for rounding.
TIE = 1e-9

CLAIMS = (
    Claim.below(
        "The weight of CI is always 0.", "6.1, Fig. 3", TIE, *_names("covariance_intersection", "weight_1")
    ),
    Claim.above("The weight of ICI is always 1.", "6.1, Fig. 3",
                1.0 - TIE, *_names("inverse_covariance_intersection", "weight_1")),
    Claim.each("CI gives the measurement itself.", "6.1",
               _names("covariance_intersection", "armse_1"), _names("alone", "armse_1"), _same),
    Claim.each("ICI gives the measurement itself.", "6.1",
               _names("inverse_covariance_intersection", "armse_1"), _names("alone", "armse_1"), _same),
    Claim("The weight of HMD-GA is 0.2 on average: within 0.05 somewhere on the grid.", "6.1, Fig. 3",
          _names("harmonic_mean", "weight_1"), _somewhere_a_fifth),
    Claim("HMD-GA gives the measurement more weight than the prior: everywhere on the grid.", "6.1",
          _names("harmonic_mean", "weight_1"), lambda *weights: [m for w in weights for m in (w, 0.5 - w)]),
    Claim.below(
        "HMD-GA is consistent: in this problem, everywhere on the grid.", "7", 1.0, *_names("harmonic_mean", "nees_1")
    ),
    Claim.below("HMD-GA is consistent: variances 1 and 10, correlation 0.9, weights by (77).", "4.2, 7",
                1.0, "given-harmonic_mean@ratio10_rho0_9/nees_1"),
    Claim.below("HMD-GA is consistent near perfect correlation: variances 1 and 10, correlation 0.99, weights 1/2.",
                "4.2", 1.0, "given-harmonic_mean@half_ratio10_rho0_99/nees_1"),
)  # fmt: skip

SCENARIO = Scenario(
    key="sharma-scalar",
    title="A scalar random walk, prior and measurement fused",
    paper=f"{PAPER}, 6.1, Fig. 3",
    shows="that weights by their own covariance make CI and ICI drop the prior, and what HMD-GA does instead",
    published_runs=500,
    default_runs=500,
    publication_runs=500,
    assumptions=(
        "assumed: process noise of 0.1, 1 and 10 times the measurement noise's variance 1, correlation -0.5, 0 and 0.5 "
        "of the two noises of a step: a small grid, since the paper gives none of them",
        "assumed: 100 steps, the first estimate is the measurement of step 0 with its variance",
        "omega as in (77)-(79), track 1 the prior: the weight of the prior for CI, of the measurement in the common "
        "part for ICI, of the prior in the harmonic mean for HMD-GA",
        "the average weight 0.2 is read off a figure at unknown noise: judged as a claim, not as a figure",
        "given pairs: two consistent tracks of variances 1 and 10 whose errors are correlated, 400 pairs a run",
    ),
    simulate=simulate,
    figures=figures,
    charts=charts,
    claims=CLAIMS,
    piece=50,
    rules=RULE_CHOICES,
    scores=scores,
)
