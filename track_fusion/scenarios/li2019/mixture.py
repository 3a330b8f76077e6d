"""Li et al. 2019, section 5.2, Fig. 7: two intensities (PHDs) of two and three components, one of them isolated."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from track_fusion.densities.mixture.mixture import Mixture, log_pdf
from track_fusion.densities.on_grid import kl_on_grid
from track_fusion.linalg import Array
from track_fusion.scenarios.li2019 import PAPER
from track_fusion.scenarios.li2019.common import exact_geometric, fused_intensity, intensity, scalar_mixture
from track_fusion.study.chart import Chart, Series
from track_fusion.study.claim import Claim, within
from track_fusion.study.rows import Outcomes, Progress, exact_figures, exact_rows
from track_fusion.study.rule_choice import RuleChoice
from track_fusion.study.scenario import Scenario

#: GM 1 and GM 2, the second padded by a component of weight 0.
PARTS = scalar_mixture(
    np.array([[0.7, 0.6, 0.5], [0.9, 0.8, 0.0]]),
    np.array([[10.0, 50.0, 90.0], [11.0, 52.0, 52.0]]),
    np.array([[100.0, 100.0, 200.0], [100.0, 120.0, 120.0]]),
)
#: Places of the potential targets, and of the isolated component.
TARGETS, ISOLATED = (10.5, 51.0), 90.0
#: Where intensities are evaluated: spacing a hundredth of the smallest standard deviation, all mass inside.
X = np.linspace(-150.0, 250.0, 4001)
STEP = float(X[1] - X[0])
#: Beyond this distance from the targets and from the isolated component, two of its standard deviations, is the tail.
TAIL = 2.0 * np.sqrt(200.0)

AVERAGE = RuleChoice.of("mixture_average", max_components=0)
HYBRID = RuleChoice.of("mixture_hybrid", max_components=0)
AA, GA, EXACT = "given-mixture_average", "given-mixture_hybrid", "given-mixture_hybrid@exact"


def fused_mixture(choice: RuleChoice) -> Mixture:
    """Fuse by a rule and drop what has no weight."""
    mixture = fused_intensity(choice, PARTS)
    return mixture.take(np.flatnonzero(mixture.weight > 0))


def _exact() -> Array:
    return exact_geometric(PARTS, X)


def shape_figures(values: Array) -> dict[str, float]:
    """Describe an intensity at X, (S,): number of targets and of peaks, heights, mass in the tails."""
    inner = values[1:-1]
    near = np.abs(X[:, None] - np.array([*TARGETS, ISOLATED])).min(-1) <= TAIL
    heights = [values[np.abs(X - target) < 10.0].max() for target in TARGETS]
    return {
        "expected_targets_1": values.sum() * STEP,
        "peaks_1": ((inner > values[:-2]) & (inner > values[2:])).sum(),
        "peak_target1_1": heights[0],
        "peak_target2_1": heights[1],
        "isolated_1": values[np.abs(X - ISOLATED).argmin()],
        "tail_mass_1": values[~near].sum() * STEP,
    }


def rule_row(choice: RuleChoice) -> dict[str, float]:
    """Components by ascending mean, and the shape of the whole."""
    mixture = fused_mixture(choice)
    measured = {}
    for at, part in enumerate(np.argsort(mixture.mean[:, 0], kind="stable"), 1):
        measured[f"component{at}_weight_1"] = mixture.weight[part]
        measured[f"component{at}_mean_1"] = mixture.mean[part, 0]
        measured[f"component{at}_variance_1"] = mixture.cov[part, 0, 0]
    return measured | shape_figures(intensity(mixture, X))


def _rows() -> dict[str, Callable[[], Mapping[str, float]]]:
    def alone(which: int) -> dict[str, float]:
        return {"expected_targets_1": float(PARTS.weight[which].sum())}

    return {
        "given-alone@gm1": functools.partial(alone, 0),
        "given-alone@gm2": functools.partial(alone, 1),
        AA: functools.partial(rule_row, AVERAGE),
        GA: functools.partial(rule_row, HYBRID),
        EXACT: lambda: shape_figures(_exact()),
    }


ROWS = _rows()


def scores(rules: Sequence[RuleChoice], runs: Sequence[int], seed: int, progress: Progress) -> Outcomes:
    """Divergence of the two sources from what any rules give, and of that from the sources, both averaged, (R,).

    Intensities are normalised. The arithmetic average has the least divergence of the sources from it, the exact
    geometric average the least from the sources. A rule that samples draws the same in every run.
    """
    sources = log_pdf(PARTS, X[:, None])

    def divergences(choice: RuleChoice) -> dict[str, float]:
        fused = log_pdf(fused_mixture(choice), X[:, None])
        return {
            "kld_of_sources_nats": float(kl_on_grid(sources, fused).mean()),
            "kld_from_sources_nats": float(kl_on_grid(fused, sources).mean()),
        }

    rows = {f"given-{choice.name}": functools.partial(divergences, choice) for choice in rules}
    return exact_rows(rows, runs, seed, progress)


# Charts and claims.

CHART_X = np.linspace(-30.0, 140.0, 341)
#: Components of less weight are not drawn.
VISIBLE = 0.002


def charts(outcomes: Outcomes) -> list[Chart]:
    """Fig. 7: the intensities, and the components of the geometric average."""
    lines = [Series(f"GM {k + 1}", CHART_X, intensity(PARTS.at(k), CHART_X), "dotted") for k in range(2)]
    for row, choice, label in ((AA, AVERAGE, "arithmetic"), (GA, HYBRID, "geometric")):
        if f"{row}/peaks_1" in outcomes:
            lines.append(Series(label, CHART_X, intensity(fused_mixture(choice), CHART_X)))
    if f"{EXACT}/peaks_1" in outcomes:
        lines.append(Series("geometric, exact", CHART_X, np.interp(CHART_X, X, _exact()), "dashed"))
    panels = [Chart("Fig. 7: averages at equal weights", "x", "targets per unit of x", tuple(lines))]
    if f"{GA}/peaks_1" in outcomes:
        panels.append(_component_chart())
    return panels


def _component_chart() -> Chart:
    mixture = fused_mixture(HYBRID)
    parts = [mixture.take(np.array([at])) for at in np.flatnonzero(mixture.weight > VISIBLE)]
    lines = [
        Series(f"{p.weight[0]:.4f} N({p.mean[0, 0]:.2f}, {p.cov[0, 0, 0]:.2f})", CHART_X, intensity(p, CHART_X))
        for p in parts
    ]
    return Chart("Fig. 7: components of the geometric average", "x", "targets per unit of x", tuple(lines))


CLAIMS = (
    Claim("The weights of the geometric average sum to the average of the sources' sums.", "5.1",
          (f"{GA}/expected_targets_1", "given-alone@gm1/expected_targets_1", "given-alone@gm2/expected_targets_1"),
          lambda fused, first, second: within(fused - 0.5 * (first + second), 1e-6),
          by_construction="its weights are scaled to that sum"),
    *(
        Claim.order(f"The geometric average has the higher peak at target {k}.", "Remark 9",
                    f"{AA}/peak_target{k}_1", f"{GA}/peak_target{k}_1")
        for k in (1, 2)
    ),
    *(
        Claim.order(f"The heaviest component of the geometric average at target {k} outweighs each of the arithmetic.",
                    "Remark 9", f"{AA}/component{theirs}_weight_1", f"{GA}/component{ours}_weight_1")
        for k, theirs, ours in ((1, 2, 1), (2, 4, 5))
    ),
    *(
        Claim.order(f"Without the approximation (49) the geometric average has the higher peak at target {k}.",
                    "Remark 9", f"{AA}/peak_target{k}_1", f"{EXACT}/peak_target{k}_1")
        for k in (1, 2)
    ),
    Claim.order("The geometric average has lighter tails.", "Remark 9", f"{GA}/tail_mass_1", f"{AA}/tail_mass_1"),
    Claim("The isolated component survives in the arithmetic average, a peak of less weight.", "Remark 10",
          (f"{AA}/peaks_1", f"{AA}/component5_weight_1"),
          lambda peaks, weight: [*within(peaks - 3.0, 0.5), weight, PARTS.weight[0, 2] - weight]),
    Claim("It almost vanishes from the geometric average: no peak is left of it.", "Remark 10",
          (f"{GA}/peaks_1", f"{GA}/isolated_1", f"{AA}/isolated_1"),
          lambda peaks, geometric, arithmetic: [*within(peaks - 2.0, 0.5), arithmetic - geometric]),
)  # fmt: skip

SCENARIO = Scenario(
    key="li2019-mixture",
    title="Averages of two intensities, one component isolated",
    paper=f"{PAPER}, 5.2, Fig. 7",
    shows="what a component that one source alone has becomes in the arithmetic and in the geometric average",
    assumptions=(
        "the geometric average takes its number of targets from the arithmetic average, as in section 5.2",
        "@exact: the geometric average without the approximation (49), point by point",
        "assumed: a target's peak is the highest value within 10 of it; the tails begin two standard deviations of the "
        "isolated component, 28.3, beyond the targets and that component",
        "components are numbered by ascending mean",
    ),
    simulate=functools.partial(exact_rows, ROWS),
    figures=exact_figures,
    charts=charts,
    claims=CLAIMS,
    piece=1,
    rules=(AVERAGE, HYBRID),
    scores=scores,
)
