"""Li et al. 2019, section 3, Figs. 1 to 4: averages of two random variables, normal or Poisson (v-fusion)."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import numpy as np

from track_fusion.linalg import Array
from track_fusion.metrics.accuracy import Estimate
from track_fusion.random_streams import stream
from track_fusion.scenarios.li2019 import PAPER
from track_fusion.scenarios.li2019.averages import (
    arithmetic_moments,
    average_moments,
    error_moments,
    lognormal_moments,
    relative_variance,
    variance_bounds,
)
from track_fusion.scenarios.li2019.variable_pairs import MEAN, VARIANCES, Variables, normal_pair, poisson_pair
from track_fusion.study.chart import Chart, Series
from track_fusion.study.claim import Claim, ascending, within
from track_fusion.study.rows import Outcomes, Progress, chosen, exact_rows
from track_fusion.study.scenario import Scenario

#: Pairs of variables drawn in one run: what fits the cache at all weights.
PAIRS = 1000
#: Weights of the first variable, and of both.
WEIGHT = np.linspace(0.0, 1.0, 51)
WEIGHTS = np.stack([WEIGHT, 1.0 - WEIGHT], -1)
TRUTHS = (45, 55, 65)
AA, GA = "given-arithmetic_average", "given-geometric_average"
AVERAGES = {AA: False, GA: True}


# The variables.


def _normal(correlation: float, truths: tuple[int, ...] = ()) -> Variables:
    label = f"correlation {correlation:g}"
    return Variables(label, functools.partial(normal_pair, correlation=correlation), 55.0, truths)


def _poisson(correlation: float) -> Variables:
    make = functools.partial(poisson_pair, correlation=correlation)
    return Variables(f"correlation {correlation:g}", make, 11.0)


#: Fig. 1 shows three correlations, Fig. 3 the first of them, Fig. 4 the last of the table.
VARIABLES = {
    "rho0": _normal(0.0, TRUTHS),
    "rho60": _normal(0.6),
    "rho70846": _normal(0.70846),
    "rho70736": _normal(0.70736, TRUTHS),
    "poisson_rho0": _poisson(0.0),
    "poisson_rho60": _poisson(0.6),
    "poisson_rho95": _poisson(0.95),
}
FIGURE_1, FIGURE_2 = ("rho0", "rho60", "rho70846"), ("poisson_rho0", "poisson_rho60", "poisson_rho95")


# What nothing random goes into.


def _two_lognormals() -> tuple[Array, Array]:
    return lognormal_moments(np.zeros(2), np.ones(2))


def lognormal_arithmetic() -> dict[str, float]:
    """Two independent lognormal variables: least variance of their arithmetic average."""
    variance = _two_lognormals()[1]
    return {"least_variance_1": float(variance_bounds(variance[0], variance[1], np.asarray(0.0))[0])}


def lognormal_geometric() -> dict[str, float]:
    """Give the least variance of the geometric average of the same, which by symmetry is at equal weights."""
    log_moments = arithmetic_moments(np.zeros(2), np.eye(2), np.array([0.5, 0.5]))
    return {"least_variance_1": float(lognormal_moments(*log_moments)[1])}


def error_correlation(truth: float) -> dict[str, float]:
    """Correlation beta of the errors of the variables of Fig. 4, and the limit (26) below which averaging helps."""
    cross = 0.70736 * np.sqrt(VARIANCES.prod())
    moments = error_moments(MEAN, np.array([[VARIANCES[0], cross], [cross, VARIANCES[1]]]), truth)
    squares = np.diagonal(moments)
    beta = moments[0, 1] / np.sqrt(squares.prod())
    return {"beta_1": float(beta), "limit_26_1": float(np.sqrt(squares.min() / squares.max()))}


def swapped_ratio() -> dict[str, float]:
    """(19), (20) as printed for variances 200 and 100 (ratio 1/2) and correlation .8, and what holds."""
    ratio, correlation = 0.5, 0.8
    cross = correlation * np.sqrt(ratio)
    weight = (1.0 - cross) / (1.0 + ratio - 2.0 * cross)
    bound = 200.0 * relative_variance(np.asarray(weight), np.asarray(ratio), np.asarray(correlation))
    least = variance_bounds(np.asarray(200.0), np.asarray(100.0), np.asarray(correlation))[0]
    return {"weight_19_1": float(weight), "bound_20_1": float(bound), "least_variance_1": float(least)}


EXACT: dict[str, Callable[[], dict[str, float]]] = {
    f"{AA}@lognormal": lognormal_arithmetic,
    f"{GA}@lognormal": lognormal_geometric,
    f"{AA}@theta50": functools.partial(error_correlation, 50.0),
    f"{AA}@theta55": functools.partial(error_correlation, 55.0),
    f"{AA}@swapped": swapped_ratio,
}


# Outcomes and figures.

ROWS = {f"{average}@{variant}": (average, variant) for variant in VARIABLES for average in AVERAGES}


def simulate(runs: Sequence[int], seed: int, progress: Progress, only: str = "") -> Outcomes:
    """Draw pairs and average them at every weight.

    Returns
    -------
    {row: first and second moments about the origin of each run's pairs, (R, 2, W)}, and the exact rows' figures, (R,)
    """
    wanted = chosen(ROWS | dict.fromkeys(EXACT, ("", "")), only)
    exact = {row: EXACT[row] for row in wanted if row in EXACT}
    outcomes = exact_rows(exact, runs, seed, lambda share: None) if exact else {}
    outcomes |= {row: np.empty((len(runs), 2, len(WEIGHT))) for row in wanted if row in ROWS}
    for i, run in enumerate(runs):
        normals = stream(seed, run, "pairs").standard_normal((PAIRS, 2))
        for variant, variables in VARIABLES.items():
            rows = [f"{average}@{variant}" for average in AVERAGES if f"{average}@{variant}" in wanted]
            values = variables.make(normals) if rows else normals
            for row in rows:
                outcomes[row][i] = _moments(values, AVERAGES[ROWS[row][0]], variables.origin)
        progress((i + 1) / len(runs))
    return outcomes


def _moments(values: Array, geometric: bool, origin: float) -> Array:
    """First and second moment about the origin of an average at all weights, (2, W)."""
    if geometric:
        mean, variance = average_moments(values, np.full(len(values), 1.0 / len(values)), WEIGHTS, True)
    else:
        mean, variance = arithmetic_moments(values.mean(0), np.cov(values.T, bias=True), WEIGHTS)
    return np.stack([mean - origin, variance + (mean - origin) ** 2])


def variance_curve(moments: Array) -> Array:
    """Variance over the weights from moments (..., 2, W): (..., W)."""
    return np.asarray(moments[..., 1, :] - moments[..., 0, :] ** 2)


def error_curve(moments: Array, offset: float) -> Array:
    """Mean square error over the weights about a parameter so far above the origin: (..., W)."""
    return np.asarray(moments[..., 1, :] - 2.0 * offset * moments[..., 0, :] + offset**2)


def lowest(curve: Array) -> tuple[Array, Array]:
    """Least value (...) of convex curves over the weights (..., W), and the weight (...), by a parabola."""
    at = np.clip(curve.argmin(-1), 1, curve.shape[-1] - 2)[..., None]
    left, middle, right = (np.take_along_axis(curve, at + k, -1)[..., 0] for k in (-1, 0, 1))
    slope, curvature = 0.5 * (right - left), left - 2.0 * middle + right
    shift = np.clip(-slope / curvature, -1.0, 1.0)
    value = middle + slope * shift + 0.5 * curvature * shift**2
    return value, WEIGHT[at[..., 0]] + shift * (WEIGHT[1] - WEIGHT[0])


def greater_share(difference: Array) -> Array:
    """Share of the weights at which a difference (..., W), straight between them, is positive."""
    # At both ends the averages are the same variable: what is left there is rounding.
    inner = difference.copy()
    inner[..., [0, -1]] = 0.0
    above, size = inner.clip(0), np.abs(inner)
    return np.asarray(((above[..., 1:] + above[..., :-1]) / (size[..., 1:] + size[..., :-1])).mean(-1))


Curve = Callable[[Array], Array]


def _curves(variables: Variables) -> dict[str, Curve]:
    """What is minimised over the weights, by name: moments (..., 2, W) -> (..., W)."""
    curves: dict[str, Curve] = {"variance": variance_curve}
    for truth in variables.truths:
        curves[f"mse_theta{truth}"] = functools.partial(error_curve, offset=truth - variables.origin)
    return curves


def figures(outcomes: Outcomes) -> dict[str, Estimate]:
    """Least variance and mean square errors with their weights; at what share of weights the arithmetic has more."""
    measured: dict[str, Estimate] = {}
    for name, values in outcomes.items():
        if values.ndim == 1:
            measured[name] = Estimate.exact(values[0])
            continue
        _, variant = ROWS[name]
        for what, curve in _curves(VARIABLES[variant]).items():
            measured[f"{name}/least_{what}_1"] = Estimate.of_averages(values, lambda m, c=curve: lowest(c(m))[0])  # type: ignore[misc]
            measured[f"{name}/weight_least_{what}_1"] = Estimate.of_averages(values, lambda m, c=curve: lowest(c(m))[1])  # type: ignore[misc]
        origin, half = VARIABLES[variant].origin, len(WEIGHT) // 2
        measured[f"{name}/mean_half_1"] = Estimate.of_averages(values[:, 0, half], lambda m, o=origin: m + o)  # type: ignore[misc]
    for variant, variables in VARIABLES.items():
        rows = [f"{average}@{variant}" for average in AVERAGES]
        if all(row in outcomes for row in rows):
            measured |= _comparison(rows[0], variables, np.stack([outcomes[row] for row in rows], 1))
    return measured


def _comparison(row: str, variables: Variables, both: Array) -> dict[str, Estimate]:
    """Figures that need both averages, (R, 2 averages, 2, W)."""
    measured = {}
    for what, curve in _curves(variables).items():

        def difference(m: Array, curve: Curve = curve) -> Array:
            return greater_share(curve(m[:, 0]) - curve(m[:, 1]))

        measured[f"{row}/greater_share_{what}_1"] = Estimate.of_averages(both, difference)
    measured[f"{row}/better_variance_1"] = Estimate.of_averages(
        both[:, 0], lambda m: np.minimum(variance_curve(m)[:, 0], variance_curve(m)[:, -1])
    )
    return measured


def charts(outcomes: Outcomes) -> list[Chart]:
    """Figs. 1 to 4: variance and mean square error over the weight of the first variable."""
    content = [
        ("Fig. 1: variance, normal variables", [(v, "variance", VARIABLES[v].label) for v in FIGURE_1]),
        ("Fig. 2: variance, Poisson variables", [(v, "variance", VARIABLES[v].label) for v in FIGURE_2]),
        ("Fig. 3: mean square error, independent variables", _error_lines("rho0")),
        ("Fig. 4: mean square error, correlation 0.70736", _error_lines("rho70736")),
    ]
    panels = []
    for title, lines in content:
        series = tuple(
            Series(
                f"{'geometric' if geometric else 'arithmetic'}, {label}",
                WEIGHT,
                _curves(VARIABLES[variant])[what](outcomes[f"{average}@{variant}"].mean(0)),
                "dashed" if geometric else "line",
            )
            for variant, what, label in lines
            for average, geometric in AVERAGES.items()
            if f"{average}@{variant}" in outcomes
        )
        if series:
            panels.append(Chart(title, "weight of variable 1", title.split(": ")[1].split(",")[0], series))
    return panels


def _error_lines(variant: str) -> list[tuple[str, str, str]]:
    return [(variant, f"mse_theta{truth}", f"parameter {truth}") for truth in TRUTHS]


# Claims.

TIE = 1e-9
#: An average is unbiased when its mean is that near.
UNBIASED = 0.2


def _no_greater(text: str, source: str, variants: Sequence[str], quantity: str) -> Claim:
    """Claim that a figure of the arithmetic average is no greater than that of the geometric, variant by variant."""
    first, second = ([f"{average}@{v}/{quantity}" for v in variants] for average in AVERAGES)
    return Claim.each(text, source, first, second, lambda a, b: [b * (1.0 + TIE) - a])


def _some_of_both(*shares: Array) -> list[Array]:
    return [margin for share in shares for margin in (share, 1.0 - share)]


def _error_claims(truth: int) -> tuple[Claim, Claim]:
    shares = tuple(f"{AA}@{v}/greater_share_mse_theta{truth}_1" for v in ("rho0", "rho70736"))
    return (
        Claim(f"Parameter {truth}: the mean square error of the arithmetic average is greater than that of the "
              "geometric at some weights and smaller at others.", "Remark 3",
              shares, _some_of_both),
        _no_greater(
            f"Parameter {truth}: the least mean square error of the arithmetic average is no greater than that of "
            "the geometric.", "Remark 3",
            ("rho0", "rho70736"), f"least_mse_theta{truth}_1",
        ),
    )  # fmt: skip


CLAIMS = (
    Claim("The arithmetic average of unbiased variables is unbiased (mean 55 at equal weights).", "3.1, (12)",
          (f"{AA}@rho0/mean_half_1",), lambda mean: within(mean - MEAN.mean(), UNBIASED),
          by_construction="the mean of a sum is the sum of the means"),
    Claim.order("The mean of the geometric average is below that of the arithmetic.", "3.1",
                f"{GA}@rho0/mean_half_1", f"{AA}@rho0/mean_half_1"),
    Claim("Below the correlation (22) some weights give the arithmetic average less variance than either variable.",
          "Remark 1",
          tuple(f"{AA}@{v}/{q}" for q in ("least_variance_1", "better_variance_1") for v in ("rho0", "rho60")),
          lambda one, two, better_one, better_two: [better_one - one, better_two - two]),
    Claim("Above it, at 0.70846, the least variance is that of the better variable.", "(21), Fig. 1",
          (f"{AA}@rho70846/least_variance_1", f"{AA}@rho70846/better_variance_1"),
          lambda least, better: within(least / better - 1.0, 1e-3)),
    *(
        Claim(f"{kind} variables: the arithmetic average has more variance at some weights, the geometric at others.",
              f"Remark 2, {figure}", tuple(f"{AA}@{v}/greater_share_variance_1" for v in variants), _some_of_both)
        for kind, figure, variants in (("Normal", "Fig. 1", FIGURE_1), ("Poisson", "Fig. 2", FIGURE_2))
    ),
    _no_greater(
        "In Figs. 1 and 2 the least variance of the arithmetic average is no greater than that of the geometric.",
        "Remark 2", FIGURE_1 + FIGURE_2, "least_variance_1",
    ),
    _no_greater("So it is for any two variables (here two independent lognormal ones of log-variance 1).",
                "6, v-fusion, conclusion 2", ("lognormal",), "least_variance_1"),
    *(claim for truth in TRUTHS for claim in _error_claims(truth)),
    Claim(
        "A parameter between the two means makes the correlation of the errors negative or zero (here 55, correlation "
        "0.70736).", "sentence after (26)",
        (f"{AA}@theta55/beta_1",), lambda beta: [TIE - beta],
    ),
    Claim("A parameter on or between the two means always fulfils (26) (here 50, correlation 0.70736).",
          "sentence after (26)", (f"{AA}@theta50/beta_1", f"{AA}@theta50/limit_26_1"), ascending),
    Claim(
        "A correlation below ratio^(-1/2) gives weights (19) between 0 and 1, at which (20) is the least variance "
        "(here variances 200 and 100, correlation 0.8; both need a correlation below ratio^(1/2), too).", "(19)-(20)",
        tuple(f"{AA}@swapped/{q}" for q in ("weight_19_1", "bound_20_1", "least_variance_1")),
        lambda weight, bound, least: [weight, 1.0 - weight, *within(bound - least, 1e-6 * least)],
    ),
)  # fmt: skip

SCENARIO = Scenario(
    key="li2019-variables",
    title="Averages of two random variables",
    paper=f"{PAPER}, 3, Figs. 1-4",
    shows="variance and mean square error of the arithmetic and the geometric average of two correlated numbers",
    default_runs=200,
    publication_runs=1000,
    assumptions=(
        "assumed: 1000 pairs of variables a run; how many the paper draws is not given",
        "assumed: the correlations 0 and 0.6 in Fig. 1 beside 0.70846, the only one in the text; 0, 0.6 and 0.95 in "
        "Fig. 2",
        "Fig. 2: rates 10 and 12 as in its caption; the text has 12 and 10",
        "assumed: a Gaussian copula couples the Poisson variables; sharing a common part reaches 0.913 at most",
        "normal variables: pairs with a value that is not positive are left out",
        "the same normal deviates make the variables of all correlations, and both averages are taken of them",
        "least values by a parabola through the lowest of 51 weights and its neighbours",
    ),
    simulate=simulate,
    figures=figures,
    charts=charts,
    claims=CLAIMS,
    piece=50,
)
