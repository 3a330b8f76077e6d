"""Li et al. 2019, section 4, Figs. 5 and 6, Appendix B: averages of two densities (f-fusion)."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from track_fusion.densities.gaussian import weighted_product
from track_fusion.linalg import Array, merged_moments
from track_fusion.rules import SourceTracks
from track_fusion.scenarios.li2019 import PAPER
from track_fusion.scenarios.li2019.averages import density_average, density_moments
from track_fusion.study.chart import Chart, Contours, Series
from track_fusion.study.claim import Claim, within
from track_fusion.study.rows import Outcomes, Progress, exact_figures, exact_rows
from track_fusion.study.rule_choice import RuleChoice
from track_fusion.study.scenario import Scenario

#: Weights of the first density, the ends apart, and values of the parameter.
WEIGHT = np.linspace(0.0, 1.0, 101)[1:-1]
THETA = np.linspace(40.0, 80.0, 401)
AA, GA = "given-arithmetic_average", "given-geometric_average"
RULE_CHOICES = (
    RuleChoice.of("arithmetic_average", criterion="given", weights=(0.5, 0.5)),
    RuleChoice.of("geometric_average", criterion="given", weights=(0.5, 0.5)),
)


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two scalar Gaussian densities, mean and variance each."""

    means: tuple[float, float]
    variances: tuple[float, float]

    @property
    def tracks(self) -> SourceTracks:
        """The densities as a rule takes them."""
        return SourceTracks(np.array(self.means)[:, None], np.array(self.variances)[:, None, None])

    def moments(self, average: str, weight: Array) -> tuple[Array, Array]:
        """Mean (32), (35) and variance (33), (34) of an average at weights (W,) of the first: (W,) each."""
        weights, tracks = np.stack([weight, 1.0 - weight], -1), self.tracks
        mean = np.broadcast_to(tracks.mean, (len(weight), 2, 1))
        cov = np.broadcast_to(tracks.cov, (len(weight), 2, 1, 1))
        fused_mean, fused_cov = (merged_moments if average == AA else weighted_product)(mean, cov, weights)
        return fused_mean[:, 0], fused_cov[:, 0, 0]

    def errors(self, average: str, weight: Array, theta: Array) -> Array:
        """Mean square error (4), (40), (41) about the parameter: weights (W,), parameters (T,) -> (T, W)."""
        mean, variance = self.moments(average, weight)
        return np.asarray(variance + (mean - theta[:, None]) ** 2)

    def own_errors(self, theta: Array) -> Array:
        """Mean square errors of the two densities themselves, (T, 2)."""
        return np.asarray(np.array(self.variances) + (np.array(self.means) - theta[:, None]) ** 2)

    def excess(self, weight: Array, theta: Array) -> Array:
        """Mean square error of the arithmetic above that of the geometric average, (T, W)."""
        return self.errors(AA, weight, theta) - self.errors(GA, weight, theta)


PAIRS = {"fig5": Pair((50.0, 60.0), (100.0, 200.0)), "fig6": Pair((50.0, 60.0), (400.0, 200.0))}
SAME_VARIANCE = Pair((50.0, 60.0), (100.0, 100.0))
SAME_MEAN = Pair((50.0, 50.0), (100.0, 200.0))
APART = Pair((50.0, 80.0), (100.0, 200.0))


def half_moments(choice: RuleChoice, pair: Pair) -> dict[str, float]:
    """Fuse by a rule: mean and variance."""
    fused = choice.fuse(pair.tracks)
    return {"mean_1": float(fused.mean[0]), "variance_1": float(fused.cov[0, 0])}


def arithmetic_row(pair: Pair) -> dict[str, float]:
    """Moments at equal weights; how the arithmetic average stands to the geometric and to its sources."""
    variance, other = (pair.moments(average, WEIGHT)[1] for average in (AA, GA))
    excess, own = pair.excess(WEIGHT, THETA), pair.own_errors(THETA)
    errors = pair.errors(AA, WEIGHT, THETA)
    less = (excess < 0).any(-1)
    where_less = {"less_mse_from_theta_1": THETA[less].min()} if less.any() else {}
    return (
        half_moments(RULE_CHOICES[0], pair)
        | {
            "least_excess_variance_1": (variance - other).min(),
            "greater_mse_share_1": (excess > 0).mean(),
            "least_mse_ratio_1": (errors / own.min(-1, keepdims=True)).min(),
            "greatest_mse_ratio_1": (errors / own.max(-1, keepdims=True)).max(),
            "crossed_theta_share_1": (less & (excess > 0).any(-1)).mean(),
        }
        | where_less
    )


def geometric_row(pair: Pair) -> dict[str, float]:
    """Moments at equal weights; extremes over weights and parameters."""
    variance = pair.moments(GA, WEIGHT)[1]
    return half_moments(RULE_CHOICES[1], pair) | {
        "least_variance_1": variance.min(),
        "greatest_variance_1": variance.max(),
        "least_mse_1": pair.errors(GA, WEIGHT, THETA).min(),
    }


def excess_row(pair: Pair, theta: Array) -> dict[str, float]:
    """Least excess of the arithmetic average's mean square error over weights and parameters."""
    return {"least_excess_mse_1": pair.excess(WEIGHT, theta).min()}


def far_row() -> dict[str, float]:
    """Variance of the arithmetic average of densities far apart over the greater of their variances."""
    return {"variance_ratio_1": half_moments(RULE_CHOICES[0], APART)["variance_1"] / max(APART.variances)}


# Appendix B.

END, MIDDLE = 4.0 * np.sqrt(2.0) / 3.0, np.sqrt(2.0)
PARAMETER = 2.0 * np.sqrt(2.0) / 3.0


def appendix_densities(end: float = END) -> tuple[Array, Array, Array]:
    """Uniform density on (0, end] and density x on (0, sqrt 2]: nodes and weights of a quadrature, densities (2, N).

    Notes    Gauss-Legendre to either end, the nodes squared in the first part: there the root of x is a polynomial.
    """
    points, width = np.polynomial.legendre.leggauss(20)
    points, width = 0.5 * (points + 1.0), 0.5 * width
    first, second = sorted((end, MIDDLE))
    x = np.concatenate([first * points**2, first + (second - first) * points])
    widths = np.concatenate([2.0 * first * points * width, (second - first) * width])
    densities = np.stack([np.where(x < end, 1.0 / end, 0.0), np.where(x < MIDDLE, x, 0.0)])
    return x, widths, densities


def appendix_mean(average: str = "", which: int = 0, end: float = END) -> dict[str, float]:
    """Mean of an average at equal weights, or of one of the two densities."""
    x, width, densities = appendix_densities(end)
    half = np.array([0.5, 0.5])
    density = density_average(densities, width, half, average == GA) if average else densities[which]
    return {"mean_1": float(density_moments(x, density, width)[0])}


def _rows() -> dict[str, Callable[[], Mapping[str, float]]]:
    rows: dict[str, Callable[[], Mapping[str, float]]] = {}
    for name, pair in PAIRS.items():
        rows[f"{AA}@{name}"] = functools.partial(arithmetic_row, pair)
        rows[f"{GA}@{name}"] = functools.partial(geometric_row, pair)
    rows[f"{AA}@same_variance"] = functools.partial(excess_row, SAME_VARIANCE, THETA)
    rows[f"{AA}@same_mean"] = functools.partial(excess_row, SAME_MEAN, np.array([50.0]))
    rows[f"{AA}@far"] = far_row
    rows["given-alone@appendix_uniform"] = functools.partial(appendix_mean, which=0)
    rows["given-alone@appendix_rising"] = functools.partial(appendix_mean, which=1)
    rows["given-alone@appendix_uniform_to_1"] = functools.partial(appendix_mean, which=0, end=1.0)
    rows[f"{AA}@appendix"] = functools.partial(appendix_mean, AA)
    rows[f"{GA}@appendix"] = functools.partial(appendix_mean, GA)
    return rows


ROWS = _rows()


def scores(rules: Sequence[RuleChoice], runs: Sequence[int], seed: int, progress: Progress) -> Outcomes:
    """Root of the mean square error (3) of what any rules make of Figs. 5 and 6, averaged over the parameter, (R,)."""

    def errors(choice: RuleChoice) -> dict[str, float]:
        fused = {name: choice.fuse(pair.tracks) for name, pair in PAIRS.items()}
        squares = {name: f.cov[0, 0] + (f.mean[0] - THETA) ** 2 for name, f in fused.items()}
        return {f"{name}_rms_error_1": float(np.sqrt(square.mean())) for name, square in squares.items()}

    rows = {f"given-{choice.name}": functools.partial(errors, choice) for choice in rules}
    return exact_rows(rows, runs, seed, progress)


# Charts.

CHART_THETA, CHART_WEIGHT = THETA[::5], np.linspace(0.0, 1.0, 51)
LEVELS = (150.0, 200.0, 300.0, 400.0, 600.0)
EXCESS_LEVELS = (-50.0, 0.0, 50.0, 100.0)


def charts(outcomes: Outcomes) -> list[Chart]:
    """Figs. 5 and 6: variances, mean square errors and their difference; Appendix B: the densities."""
    panels = []
    for name, pair in PAIRS.items():
        title = f"Fig. {name[-1]}"
        averages = [a for a in (AA, GA) if f"{a}@{name}/mean_1" in outcomes]
        if averages:
            panels.append(_variance_chart(title, pair, averages))
            lines = tuple(_contours(a, pair.errors(a, CHART_WEIGHT, CHART_THETA), LEVELS) for a in averages)
            lines_at = ", ".join(f"{level:g}" for level in LEVELS)
            panels.append(_plane(f"{title}: mean square error (lines at {lines_at})", lines))
        if len(averages) == 2:
            inner = CHART_WEIGHT[1:-1]  # at both ends the averages are equal
            excess = pair.excess(inner, CHART_THETA)
            levels = [level for level in EXCESS_LEVELS if excess.min() < level < excess.max()]
            levelled = tuple(Contours(f"{level:g}", inner, CHART_THETA, excess, (level,)) for level in levels)
            panels.append(_plane(f"{title}: mean square error, arithmetic minus geometric", levelled))
    if f"{GA}@appendix/mean_1" in outcomes:
        panels.append(_appendix_chart())
    return panels


def _variance_chart(title: str, pair: Pair, averages: Sequence[str]) -> Chart:
    lines = [Series(_word(a), CHART_WEIGHT, pair.moments(a, CHART_WEIGHT)[1]) for a in averages]
    for i, variance in enumerate(pair.variances):
        lines.append(Series(f"density {i + 1}", np.array([0.0, 1.0]), np.full(2, variance), "dotted"))
    return Chart(f"{title}: variance", "weight of density 1", "variance", tuple(lines))


def _plane(title: str, contours: tuple[Contours, ...]) -> Chart:
    return Chart(title, "weight of density 1", "parameter", contours=contours)


def _contours(average: str, z: Array, levels: tuple[float, ...]) -> Contours:
    return Contours(_word(average), CHART_WEIGHT, CHART_THETA, z, levels)


def _word(average: str) -> str:
    return "arithmetic" if average == AA else "geometric"


def _appendix_chart() -> Chart:
    x = np.linspace(0.0, 1.1 * END, 200)
    densities = np.stack([np.where(x <= END, 1.0 / END, 0.0), np.where(x <= MIDDLE, x, 0.0)])
    width = np.full(len(x), x[1] - x[0])
    half = np.array([0.5, 0.5])
    lines = [Series(f"density {i + 1}", x, densities[i], "dotted") for i in range(2)]
    lines += [Series(_word(a), x, density_average(densities, width, half, a == GA)) for a in (AA, GA)]
    return Chart("Appendix B: averages at equal weights", "x", "density", tuple(lines))


# Claims.

#: Sums and products round.
TIE = 1e-9
#: The variances of the sources in Figs. 5 and 6.
LEAST_VARIANCES, GREATEST_VARIANCES = (100.0, 200.0), (200.0, 400.0)


def _not_below(figure: Array, bound: float) -> Array:
    """Margin of a figure that reaches its bound."""
    return figure - (1.0 - TIE) * bound


def _not_above(figure: Array, bound: float) -> Array:
    return (1.0 + TIE) * bound - figure


def _figures(quantity: str, average: str = AA) -> tuple[str, ...]:
    return tuple(f"{average}@{name}/{quantity}" for name in PAIRS)


CLAIMS = (
    Claim("At the same weights the variance of the arithmetic average is greater than that of the geometric.",
          "Remark 5", _figures("least_excess_variance_1"), lambda *excesses: excesses),
    Claim(
        "The variance of the geometric average lies between those of its sources.",
        "Remark 5, (36)",
        (*_figures("least_variance_1", GA), *_figures("greatest_variance_1", GA)),
        lambda a, b, c, d: [
            *(_not_below(low, least) for low, least in zip((a, b), LEAST_VARIANCES, strict=True)),
            *(_not_above(high, most) for high, most in zip((c, d), GREATEST_VARIANCES, strict=True)),
        ],
        by_construction="a weighted harmonic mean lies between what it averages",
    ),
    Claim(
        "That of the arithmetic average may exceed both of its sources' (here means 50 and 80, variances 100 and 200).",
        "Remark 5",
        (f"{AA}@far/variance_ratio_1",),
        lambda ratio: [ratio - 1.0],
    ),
    Claim("The mean square error of the arithmetic average lies between those of its sources.", "Remark 6",
          (*_figures("least_mse_ratio_1"), *_figures("greatest_mse_ratio_1")),
          lambda a, b, c, d: [_not_below(a, 1.0), _not_below(b, 1.0), _not_above(c, 1.0), _not_above(d, 1.0)],
          by_construction="a weighted mean lies between what it averages"),
    Claim("The mean square error of the geometric average is no less than the least variance of its sources.", "(42)",
          _figures("least_mse_1", GA),
          lambda *errors: [_not_below(e, least) for e, least in zip(errors, LEAST_VARIANCES, strict=True)]),
    Claim("Densities of the same variance, or both with the parameter as their mean: the mean square error of the "
          "geometric average is no greater than that of the arithmetic.", "Remark 7",
          (f"{AA}@same_variance/least_excess_mse_1", f"{AA}@same_mean/least_excess_mse_1"),
          lambda *excesses: [excess + TIE for excess in excesses]),
    Claim("In most cases the mean square error of the arithmetic average is greater than that of the geometric.",
          "Remark 8", _figures("greater_mse_share_1"), lambda *shares: [share - 0.5 for share in shares]),
    Claim(
        "It is smaller only where the parameter is well above both means and the density with the greater mean has the "
        "greater variance (in Fig. 5 above 60; never in Fig. 6).",
        "Remark 8",
        (f"{AA}@fig5/less_mse_from_theta_1", f"{AA}@fig6/greater_mse_share_1"),
        lambda theta, share: [theta - 60.0, _not_below(share, 1.0)],
    ),
    Claim(
        "For given densities and parameter one of the two averages has the smaller mean square error at all weights.",
        "Remark 8", _figures("crossed_theta_share_1"), lambda *shares: [TIE - share for share in shares],
    ),
    Claim("The uniform density is an unbiased estimator on the interval (0, 1] that is printed.", "Appendix B",
          ("given-alone@appendix_uniform_to_1/mean_1",), lambda mean: within(mean - PARAMETER, TIE)),
    Claim("It is on (0, 4 sqrt(2)/3], and so are the other density and the arithmetic average.", "Appendix B, (30)",
          ("given-alone@appendix_uniform/mean_1", "given-alone@appendix_rising/mean_1", f"{AA}@appendix/mean_1"),
          lambda *means: [margin for mean in means for margin in within(mean - PARAMETER, TIE)]),
    Claim.order("The geometric average of unbiased densities is biased.", "4.1, Appendix B",
                f"{GA}@appendix/mean_1", f"{AA}@appendix/mean_1"),
)  # fmt: skip

SCENARIO = Scenario(
    key="li2019-densities",
    title="Averages of two densities",
    paper=f"{PAPER}, 4, Figs. 5, 6, Appendix B",
    shows="variance and mean square error of the arithmetic and the geometric average of two Gaussian densities",
    published={f"{GA}@appendix/mean_1": 0.8485, f"{AA}@appendix/mean_1": 0.9428},  # 3 sqrt(2)/5, 2 sqrt(2)/3
    assumptions=(
        "closed forms (32)-(35), (40), (41) in place of the paper's Monte Carlo simulation",
        "mean square error: of a draw from the fused density, (3), the parameter being fixed",
        "means and variances at weights 1/2; extremes over 99 weights inside (0, 1) and 401 parameters from 40 to 80",
        "Appendix B: the uniform density ends at 4 sqrt(2)/3; the (0, 1] of the text is a misprint",
        "assumed: variances 100 and 100, or means 50 and 50, for Remark 7; means 50 and 80 for Remark 5",
        "printed means of Appendix B, 3 sqrt(2)/5 and 2 sqrt(2)/3, as decimals",
    ),
    simulate=functools.partial(exact_rows, ROWS),
    figures=exact_figures,
    charts=charts,
    claims=CLAIMS,
    piece=1,
    rules=RULE_CHOICES,
    scores=scores,
)
