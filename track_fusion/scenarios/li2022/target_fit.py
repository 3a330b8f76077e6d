"""Li et al., AA density fusion, Fig. 2: four Gaussian densities mixed so as to fit a target best, in four cases."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial

import numpy as np

from track_fusion.densities.gaussian import kl_divergence
from track_fusion.densities.mixture.mixture import Mixture, gaussian, log_pdf
from track_fusion.densities.on_grid import kl_on_grid
from track_fusion.linalg import Array
from track_fusion.metrics.accuracy import Estimate
from track_fusion.rules import FusedTracks, SourceTracks
from track_fusion.scenarios.li2022 import PAPER
from track_fusion.study.chart import Chart, Series, Style
from track_fusion.study.claim import Claim, ascending, within
from track_fusion.study.rows import Outcomes, Progress, exact_rows
from track_fusion.study.rule_choice import RuleChoice, rule_by_rule
from track_fusion.study.scenario import Scenario

#: Section III-B: mean and variance of the densities and of the target in each case.
DENSITIES = np.array([[40.0, 400.0], [50.0, 200.0], [60.0, 100.0], [100.0, 400.0]])
TARGETS = {"1": (60.0, 200.0), "2": (70.0, 100.0), "3": (85.0, 150.0), "4": (110.0, 300.0)}
#: Section III-B, Fig. 2: the optimal weights (of case 1, whose optimum is a segment, none), and the fused moments.
WEIGHTS = {"2": (0.0, 0.0, 0.966, 0.034), "3": (0.0, 0.0, 0.2738, 0.7262), "4": (0.0, 0.0, 0.0, 1.0)}
MOMENTS = {"1": (60.0, 200.0), "2": (61.36, 162.82), "3": (89.05, 635.98), "4": (100.0, 400.0)}
#: All densities are evaluated between these points.
LOW, HIGH = -100.0, 260.0
POINTS = np.linspace(LOW, HIGH, 20001)[:, None]
#: Every so many of these points, out of the middle, is drawn.
DRAWN = slice(4000, 17001, 40)

RULE_CHOICES = (
    RuleChoice.of("arithmetic_average", criterion="target"),
    RuleChoice.of("arithmetic_average", "diversity", criterion="diversity"),
    RuleChoice.of("arithmetic_average", "uniform", criterion="uniform"),
    RuleChoice.of("arithmetic_average", "target_mixture", criterion="target_mixture"),
)
#: The best fit of the merged Gaussian (39), the best of the mixture itself (33), and other weights.
BEST, FITTED, OTHERS = RULE_CHOICES[0], RULE_CHOICES[3], RULE_CHOICES[1:3]
#: Below this a divergence, in nats, counts as none.
ROUNDING = 1e-9


def alone(case: str, density: int) -> dict[str, Array]:
    """How far a density by itself, counted from 0, is from the target of a case, in nats."""
    return {"kld": divergence(DENSITIES[density, :1], DENSITIES[density, 1:, None], case)}


def merged(case: str, choice: RuleChoice) -> dict[str, Array]:
    """How far the mixture at a rule's weights, made one Gaussian, is from the target; of the best what is printed."""
    fused = fit(choice, case)
    measured = {"kld": divergence(fused.mean, fused.cov, case)}
    if choice is BEST:
        assert fused.weights is not None
        measured |= {"mean": fused.mean[0], "variance": fused.cov[0, 0], "weights": fused.weights}
    return measured


def not_merged(case: str) -> dict[str, Array]:
    """How far the mixture at the best weights is from the target, and its components on average."""
    weights = fit(BEST, case).weights
    assert weights is not None
    each = [divergence(one[:1], one[1:, None], case) for one in DENSITIES]
    return {"kld": np.array(mixed_divergence(weights, case)), "mean_kld": weights @ each}


def itself(case: str) -> dict[str, Array]:
    """How far the mixture that fits best itself, (33), is from the target, and its weights."""
    weights = fit(FITTED, case).weights
    assert weights is not None
    return {"kld": np.array(mixed_divergence(weights, case)), "weights": weights}


def best(case: str) -> str:
    """Name the row of the best average in a case."""
    return f"given-{BEST.key}@case_{case}"


def mixture(case: str) -> str:
    """Name the row of the best average before it is merged."""
    return f"given-{BEST.key}@mixture_case_{case}"


def fitted(case: str) -> str:
    """Name the row of the mixture that fits best itself in a case."""
    return f"given-{FITTED.key}@{FITTED.variant}_case_{case}"


def singles(case: str) -> list[str]:
    """Name the rows of the densities by themselves."""
    return [f"given-alone@density_{i}_case_{case}" for i in range(1, len(DENSITIES) + 1)]


def _rows() -> dict[str, Callable[[], dict[str, Array]]]:
    """Every row: the best average merged and not, the best mixture, averages at other weights, single densities."""
    rows: dict[str, Callable[[], dict[str, Array]]] = {}
    for case in TARGETS:
        rows[best(case)], rows[mixture(case)] = partial(merged, case, BEST), partial(not_merged, case)
        rows[fitted(case)] = partial(itself, case)
        rows |= {f"given-{c.key}@{c.variant}_case_{case}": partial(merged, case, c) for c in OTHERS}
        rows |= {name: partial(alone, case, i) for i, name in enumerate(singles(case))}
    return rows


ROWS = _rows()


def target_of(case: str) -> Mixture:
    """Return the target of a case, (1,) component."""
    return scalar_gaussian(*TARGETS[case])


def scalar_gaussian(mean: float, variance: float) -> Mixture:
    """Make a Gaussian of one axis, (1,) component."""
    return gaussian(np.array([mean]), np.array([[variance]]))


def fit(choice: RuleChoice, case: str) -> FusedTracks:
    """Fuse the four densities by any rule that the target is enough for."""
    tracks = SourceTracks(DENSITIES[:, :1], DENSITIES[:, 1:, None], extras={"target": target_of(case)})
    return choice.fuse(tracks)


def divergence(mean: Array, cov: Array, case: str) -> Array:
    """Divergence of N(mean, cov), (1,) and (1, 1), from the target, in nats."""
    target = target_of(case)
    return kl_divergence(mean, cov, target.mean[0], target.cov[0])


def mixed_divergence(weights: Array, case: str) -> float:
    """Divergence of the mixture at weights (4,) from the target, in nats, by summation over POINTS."""
    mixed, target = Mixture(weights, DENSITIES[:, :1], DENSITIES[:, 1:, None]), target_of(case)
    return float(kl_on_grid(log_pdf(mixed, POINTS), log_pdf(target, POINTS)))


def figures(outcomes: Outcomes) -> dict[str, Estimate]:
    """Divergences, moments, and the weights where they are unique."""
    measured = {}
    for name, values in outcomes.items():
        row, _, what = name.rpartition("/")
        if what != "weights":
            measured[f"{name}_{'nats' if what.endswith('kld') else '1'}"] = Estimate.exact(values[0])
        elif row.rpartition("_")[2] in WEIGHTS or FITTED.variant in row:
            measured |= {f"{row}/weight_{i}_1": Estimate.exact(w) for i, w in enumerate(values[0], 1)}
    return measured


def scores(choices: Sequence[RuleChoice], runs: Sequence[int], seed: int, progress: Progress) -> Outcomes:
    """Divergence of the fused Gaussian from the target by case, (R,), under any rules; nothing is random."""

    def measure(choice: RuleChoice) -> Outcomes:
        fits = {case: fit(choice, case) for case in TARGETS}
        values = {case: divergence(fused.mean, fused.cov, case) for case, fused in fits.items()}
        return {f"kld_case_{case}_nats": np.full(len(runs), value) for case, value in values.items()}

    return rule_by_rule("given", choices, progress, measure)


def charts(outcomes: Outcomes) -> list[Chart]:
    """The densities, the target and the best fit, merged and not, in each case; then the weights."""
    cases = [case for case in TARGETS if f"{best(case)}/weights" in outcomes]
    numbers = np.arange(1.0, len(DENSITIES) + 1)
    bars = [
        Series(f"case {case}", numbers, outcomes[f"{best(case)}/weights"][0], "bars")
        for case in cases
        if case in WEIGHTS
    ]
    title, ticks = "Optimal weights (of case 1 they are not unique)", {float(n): f"f{n:g}" for n in numbers}
    weights = [Chart(title, "density", "weight", tuple(bars), ticks=ticks)] if bars else []
    return [_densities(case, outcomes) for case in cases] + weights


def _densities(case: str, outcomes: Outcomes) -> Chart:
    x, target = POINTS[DRAWN], TARGETS[case]

    def line(label: str, moments: Iterable[float], style: Style = "line") -> Series:
        return Series(label, x[:, 0], np.exp(log_pdf(scalar_gaussian(*moments), x)), style)

    lines = [line(f"f{i}", one, "dotted") for i, one in enumerate(DENSITIES, 1)]
    singles_drawn = np.stack([one.y for one in lines])
    mean, variance, weights = (outcomes[f"{best(case)}/{what}"][0] for what in ("mean", "variance", "weights"))
    lines += [
        line("target", target),
        line("best average, merged", (mean, variance), "dashed"),
        Series("the same before merging", x[:, 0], weights @ singles_drawn),
    ]
    if f"{fitted(case)}/weights" in outcomes:
        own = outcomes[f"{fitted(case)}/weights"][0]
        lines.append(Series("the mixture that fits best itself", x[:, 0], own @ singles_drawn))
    return Chart(f"Case {case}: target N({target[0]:g}, {target[1]:g})", "x", "density", tuple(lines))


def _claims_of(case: str) -> list[Claim]:
    alone = tuple(f"{name}/kld_nats" for name in singles(case))
    ways = {best(case): "merged", mixture(case): "not merged", fitted(case): "fitted as a mixture"}
    return [
        Claim(f"case {case}: the mixture diverges less than its components do on average (32)", "III-A, Lemma 5",
              (f"{mixture(case)}/kld_nats", f"{mixture(case)}/mean_kld_nats"), ascending,
              by_construction="the divergence is convex"),
        Claim(f"case {case}: the mixture at its own best weights (33) fits no worse than at those of the merged (39)",
              "III-B, (33)", (f"{fitted(case)}/kld_nats", f"{mixture(case)}/kld_nats"), ascending,
              by_construction="the weights (33) are the best that there are"),
        *(
            Claim(f"case {case}: the average, {how}, fits the target better than the best single density",
                  "III-B, Fig. 2", (f"{row}/kld_nats", *alone),
                  lambda first, *rest: [other - ROUNDING - first for other in rest])
            for row, how in ways.items()
        ),
    ]  # fmt: skip


def _claims() -> tuple[Claim, ...]:
    return (
        *(claim for case in ("1", "2", "3") for claim in _claims_of(case)),
        Claim.below("case 1: the average has the very moments of the target", "III-B, Fig. 2",
                    ROUNDING, f"{best('1')}/kld_nats"),
        Claim("case 4: the best fit is the single best density", "III-B, Fig. 2",
              (f"{best('4')}/kld_nats", *(f"{name}/kld_nats" for name in singles("4"))),
              lambda first, *rest: within(first - np.min(rest, 0), ROUNDING)),
    )  # fmt: skip


def _published() -> dict[str, float]:
    printed = {f"{best(case)}/weight_{i}_1": w for case, ws in WEIGHTS.items() for i, w in enumerate(ws, 1)}
    for case, (mean, variance) in MOMENTS.items():
        printed |= {f"{best(case)}/mean_1": mean, f"{best(case)}/variance_1": variance}
    return printed


SCENARIO = Scenario(
    key="li2022-target-fit",
    title="Four densities on a line mixed to fit a target, in four cases",
    paper=f"{PAPER}, Fig. 2",
    shows="that a mixture can fit a target better than its best component, and what the best weights are",
    published=_published(),
    assumptions=(
        "the printed weights minimise the divergence (39) of the merged Gaussian, not that of the mixture (33), which "
        "is shown beside them",
        "in case 1 every point of a segment of weights is optimal: the moments are compared, the weights are not",
        "the exact variance of case 3 is 635.975: its print is one unit of the last digit off",
        "densities have no unit",
    ),
    simulate=partial(exact_rows, ROWS),
    figures=figures,
    charts=charts,
    claims=_claims(),
    rules=RULE_CHOICES,
    given=("target",),
    scores=scores,
)
