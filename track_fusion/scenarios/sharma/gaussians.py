"""Sharma et al., section 5.2, Fig. 1: two Gaussian densities fused by every rule of the paper."""

from __future__ import annotations

from functools import cache, partial

import numpy as np
from scipy.optimize import brentq

from track_fusion.densities.mixture.mixture import Mixture
from track_fusion.metrics.accuracy import Estimate
from track_fusion.scenarios.sharma import PAPER
from track_fusion.scenarios.sharma import densities as shared
from track_fusion.scenarios.sharma.densities import COVS, GMD_S, HALF, HMD_GA, HMD_S, SAMPLES, Pair, Row
from track_fusion.study.chart import Chart, Series, bars, ellipse, estimates
from track_fusion.study.claim import Claim
from track_fusion.study.rows import Outcomes
from track_fusion.study.rule_choice import RuleChoice
from track_fusion.study.scenario import Scenario

#: (75)-(76).
MEANS = np.array([[0.5, 1.0], [2.0, 1.0]])
PAIR = Pair(Mixture(np.ones((2, 1)), MEANS[:, None], COVS[:, None]))
#: The same with both means in one place.
SAME_MEAN = Pair(Mixture(np.ones((2, 1)), np.zeros((2, 1, 2)), COVS[:, None]))
#: Inflation of the covariances that HMD-S draws from, besides none.
ALPHAS = (1.1, 1.2, 1.5)
#: What counts as a small variation of alpha.
SMALL_ALPHA = 1.5

CI = RuleChoice.of("covariance_intersection", criterion="given", weights=HALF)
ICI = RuleChoice.of("inverse_covariance_intersection", criterion="given", weights=HALF)
#: Each at the weights that its own criterion finds, by the determinant.
OWN_WEIGHTS = (
    RuleChoice.of("covariance_intersection", "own_weights"),
    RuleChoice.of("inverse_covariance_intersection", "own_weights"),
    RuleChoice.of("harmonic_mean", "own_weights"),
)
RULE_CHOICES = (
    RuleChoice.of("naive"), CI, GMD_S, ICI,
    RuleChoice.of("ellipsoidal_intersection"), HMD_GA, HMD_S, *OWN_WEIGHTS,
)  # fmt: skip


def _label(alpha: float) -> str:
    return f"alpha_{alpha:g}".replace(".", "_")


def _inflated(alpha: float) -> RuleChoice:
    sampling = {"method": "sampling", "samples": SAMPLES, "inflation": alpha}
    return RuleChoice.of("harmonic_mean", f"sampled_{_label(alpha)}", criterion="given", weights=HALF, **sampling)


def _rows() -> dict[str, Row]:
    table = {f"given-{choice.name}": PAIR.by_rule(choice) for choice in RULE_CHOICES}
    for choice in OWN_WEIGHTS[1:]:
        table[f"given-{choice.name}_same_mean"] = SAME_MEAN.by_rule(choice)
    table["given-harmonic_mean@grid"] = PAIR.by_grid("harmonic")
    for alpha in ALPHAS:
        table[f"given-{_inflated(alpha).name}"] = PAIR.by_rule(_inflated(alpha))
        table[f"given-harmonic_mean@grid_{_label(alpha)}"] = PAIR.by_grid("harmonic", alpha)
    return table


ROWS = _rows()
LEAST_ALPHA = "given-harmonic_mean@grid/least_alpha_1"


def figures(outcomes: Outcomes) -> dict[str, Estimate]:
    """Moments, determinant and divergence of each row; the least alpha that exceeds the geometric mean."""
    measured = shared.figures(ROWS, outcomes)
    if "given-harmonic_mean@grid/mean" in outcomes:
        measured[LEAST_ALPHA] = Estimate.exact(least_alpha())
    return measured


def determinant(alpha: float) -> float:
    """Determinant of HMD-S at this inflation, in the limit of many samples."""
    return float(np.linalg.det(PAIR.by_grid("harmonic", alpha).fuse(np.random.default_rng()).cov))


@cache
def least_alpha() -> float:
    """Inflation at which the harmonic mean's determinant is that of the geometric mean."""
    wanted = float(np.linalg.det(PAIR.by_rule(CI).fuse(np.random.default_rng()).cov))
    return float(brentq(lambda alpha: determinant(alpha) - wanted, 1.0, 2.0, xtol=1e-6))


def charts(outcomes: Outcomes) -> list[Chart]:
    """Fig. 1a and 1b, and the determinants behind them."""
    measured = figures(outcomes)
    sources = tuple(ellipse(f"p{i + 1}", MEANS[i], COVS[i], style="dashed") for i in range(2))
    fused = {
        "GMD = CI": "given-covariance_intersection", "GMD-S": "given-geometric_mean_sampling",
        "HMD": "given-harmonic_mean@grid", "HMD-S": "given-harmonic_mean@sampled", "HMD-GA": "given-harmonic_mean",
        "ICI": "given-inverse_covariance_intersection",
    }  # fmt: skip
    inflated = {"GMD = CI": fused["GMD = CI"], "HMD-S, alpha 1": fused["HMD-S"]}
    inflated |= {f"HMD-S, alpha {a:g}": f"given-{_inflated(a).name}" for a in ALPHAS}
    panels = [
        Chart(f"86.5 % regions: {title}", "x", "y", (*sources, *_ellipses(outcomes, rows)), equal=True)
        for title, rows in (("the fusions (sampling: one run)", fused), ("inflation (one run)", inflated))
        if any(f"{row}/mean" in outcomes for row in rows.values())
    ]
    panels.append(_bars(measured))
    return panels + ([_inflation_chart(measured)] if LEAST_ALPHA in measured else [])


def _bars(measured: dict[str, Estimate]) -> Chart:
    """Determinants at equal weights, without inflation."""
    values = {
        name.partition("/")[0].removeprefix("given-"): estimate
        for name, estimate in measured.items()
        if name.endswith("/determinant_1") and "alpha" not in name and "own_weights" not in name
    }
    return bars("Determinants at weights 1/2", "determinant", values)


def _ellipses(outcomes: Outcomes, rows: dict[str, str]) -> list[Series]:
    return [
        ellipse(
            label,
            outcomes[f"{row}/mean"][0],
            outcomes[f"{row}/cov"][0],
            style="dotted" if label in ("GMD-S", "HMD-S") else "line",
        )
        for label, row in rows.items()
        if f"{row}/mean" in outcomes
    ]


def _inflation_chart(measured: dict[str, Estimate]) -> Chart:
    """Determinant of the harmonic mean over alpha: exact, and sampled where it was."""
    alpha = np.linspace(1.0, 1.6, 13)
    lines = [Series("HMD, many samples", alpha, np.array([determinant(a) for a in alpha]))]
    level = np.full(2, np.linalg.det(PAIR.by_rule(CI).fuse(np.random.default_rng()).cov))
    lines.append(Series("GMD = CI, not inflated", alpha[[0, -1]], level, "dashed"))
    names = {1.0: "given-harmonic_mean@sampled"} | {a: f"given-{_inflated(a).name}" for a in ALPHAS}
    drawn = {a: measured[f"{n}/determinant_1"] for a, n in names.items() if f"{n}/determinant_1" in measured}
    if drawn:
        lines.append(estimates("HMD-S", drawn))
    return Chart("Inflation of what is sampled", "alpha", "determinant", tuple(lines))


def _order(text: str, source: str, *rows: str) -> Claim:
    return Claim.order(text, source, *(f"given-{row}/determinant_1" for row in rows))


SCENARIO = Scenario(
    key="sharma-gaussians",
    title="Two Gaussian densities, fused by every rule of the paper",
    paper=f"{PAPER}, 5.2, Fig. 1",
    shows="how much each rule claims about the same pair, sampled beside exact, and what inflating the samples does",
    default_runs=200,
    publication_runs=1000,
    assumptions=(
        "assumed: weights 1/2 in every fusion, except @own_weights: the determinant criterion's",
        "assumed: alpha 1.1, 1.2 and 1.5, a small variation up to 1.5; the paper's are in the figure alone",
        "a run is one fusion by 5000 samples, drawn from the balanced mixture of both densities: choosing sample by "
        "sample, as in (74), biases; @grid: the density itself by summation, with alpha: the limit of many samples",
        "GMD of Gaussians is covariance intersection at the same weights",
        "@own_weights_same_mean: assumed, both means in one place, to show what the weights do",
        "divergence: of the exact harmonic mean density from the Gaussian with the fused moments",
        "the relative times of Table 1 are no figures, since times do not repeat: python -m benchmark --only rules",
    ),
    simulate=partial(shared.simulate, ROWS),
    figures=figures,
    charts=charts,
    claims=(
        _order("The covariance shrinks from GMD-S to HMD-S to HMD-GA.", "5.2, Fig. 1a",
               "harmonic_mean", "harmonic_mean@sampled", "geometric_mean_sampling"),
        Claim.least("HMD-GA claims less than ICI, HMD-S and CI at the same weights.", "6, Fig. 1a, A",
                    f"given-{HMD_GA.name}/determinant_1", [f"given-{c.name}/determinant_1" for c in (ICI, HMD_S, CI)]),
        _order("HMD-GA is tighter than ICI when each finds its own weights: (75)-(76).", "7",
               "harmonic_mean@own_weights", "inverse_covariance_intersection@own_weights"),
        _order("HMD-GA is always tighter than ICI: the same covariances, means in one place, own weights.", "7",
               "harmonic_mean@own_weights_same_mean", "inverse_covariance_intersection@own_weights_same_mean"),
        _order(f"Inflation by {SMALL_ALPHA:g} makes HMD-S wider than GMD.", "5.2, Fig. 1b",
               "harmonic_mean@sampled", "covariance_intersection", f"harmonic_mean@sampled_{_label(SMALL_ALPHA)}"),
    ),
    piece=50,
    rules=RULE_CHOICES,
    scores=PAIR.scores,
)  # fmt: skip
