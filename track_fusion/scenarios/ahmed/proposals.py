"""Ahmed, Gaussian mixture DDF, section 5.2: what the mixands of an exactly fused mixture are sampled from."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from track_fusion.densities.log_domain import log_sum_exp, normalised
from track_fusion.densities.mixture.mixture import Mixture, log_pdf
from track_fusion.densities.mixture.proposals import (
    Proposal,
    direct_local_sampling,
    heavy_tail,
    inflated_naive,
    laplace_proposals,
    prune_mixands,
)
from track_fusion.densities.mixture.quotient import Bound, Laplace, Quotient, exact_bound, exact_quotient, laplace
from track_fusion.densities.on_grid import kl_on_grid
from track_fusion.metrics.accuracy import Estimate
from track_fusion.random_streams import stream
from track_fusion.rules import RULES
from track_fusion.scenarios.ahmed import PAPER
from track_fusion.scenarios.ahmed.mixtures import CELL_AREA, GRID, INGIS_VARIANCE, Problem, contour_chart, scores, shown
from track_fusion.study.chart import Chart, Series
from track_fusion.study.claim import Claim
from track_fusion.study.rows import Outcomes, Progress, chosen, run_by_run
from track_fusion.study.rule_choice import RuleChoice
from track_fusion.study.scenario import Printed, Scenario

#: Fig. 7: divergence in nats of the true fused density from each approximation, one problem.
FIGURE_7 = {
    "given-mixture_exact@ingis": 0.2555,
    "given-mixture_exact@laplace": 0.3763,
    "given-mixture_exact@lagis": 0.1054,
    "given-mixture_exact@heavy_tail": Printed("0.0910"),
}
#: Samples a mixand; components of each source and of the common information.
MIXAND_SAMPLES, SOURCE_COUNT, COMMON_COUNT = 500, 4, 16
#: Mixands whose bound lies so far below the largest need no sampling, as mixture_exact has it.
PRUNE_NATS = RULES["mixture_exact"].params().prune_nats  # type: ignore[attr-defined]
#: A bound holds if it is no less than the true weight up to the error of the grid, in nats.
GRID_ERROR = 1e-6

PROPOSALS = ("ingis", "lagis", "heavy_tail")
#: Rows of figures: what is sampled, Laplace's approximation without sampling, the bound on the weights.
ROWS = {f"given-mixture_exact@{variant}": variant for variant in (*PROPOSALS, "laplace", "bound")}

#: What mixture_exact is told for each of the first.
VALUES: dict[str, dict[str, Any]] = {
    proposal: {"proposal": proposal, "mixand_samples": MIXAND_SAMPLES, "default_variance": INGIS_VARIANCE}
    for proposal in PROPOSALS
} | {"laplace": {"method": "laplace"}}
RULE_CHOICES = tuple(
    RuleChoice.of("mixture_exact", variant, max_components=0, **values) for variant, values in VALUES.items()
)


def problem(seed: int, run: int) -> Problem:
    """Draw a problem of sixteen mixands."""
    return Problem.drawn(stream(seed, run, "problem"), (SOURCE_COUNT,), (COMMON_COUNT,))


class Case:
    """A problem, its quotient, and what is known of that without sampling."""

    def __init__(self, seed: int, run: int) -> None:
        self.problem, self.seed, self.run = problem(seed, run), seed, run
        parts = self.problem.first, self.problem.second, self.problem.common
        self.quotient: Quotient = exact_quotient(*parts)
        self.bound: Bound = exact_bound(self.quotient, self.problem.common)
        self.laplace: Laplace = laplace(self.quotient)
        joint = self.quotient.numerator.factored.joint(GRID)
        #: Logarithm of the un-normalised mixands on the grid, (M, S), and of their integrals, (M,).
        self.log_mixands = joint - log_pdf(self.problem.common, GRID)
        self.log_weight = log_sum_exp(self.log_mixands) + np.log(CELL_AREA)

    def proposal(self, name: str) -> Proposal:
        """Return what each mixand is sampled from."""
        if name == "ingis":
            return inflated_naive(self.quotient, self.problem.first, self.problem.second, INGIS_VARIANCE)
        return laplace_proposals(self.laplace) if name == "lagis" else heavy_tail(self.laplace, self.bound.cov)

    def measure(self, name: str) -> dict[str, Any]:
        """Quantities of one row of figures."""
        if name == "bound":
            return self._bounded()
        truth = self.problem.log_exact()
        values: dict[str, Any] = {}
        if name == "laplace":
            fused = Mixture(normalised(self.laplace.log_moment), self.laplace.mean, self.laplace.cov)
        else:
            rng = stream(self.seed, self.run, "fusion")
            local = direct_local_sampling(self.quotient, self.proposal(name), rng, MIXAND_SAMPLES)
            fused, share = local.mixture, local.ess / MIXAND_SAMPLES
            values = {
                "mixands": share,
                "ess_1": float(share.mean()),
                "weighted_ess_1": float(share @ normalised(self.log_weight)),
            }
        approximation = log_pdf(fused, GRID)
        pictures = {"density": shown(approximation), "truth": shown(truth)}
        return {"kld_nats": kl_on_grid(truth, approximation)} | values | pictures

    def _bounded(self) -> dict[str, Any]:
        bound, share = self.bound.log_weight, normalised(self.log_weight)
        kept = prune_mixands(self.quotient, bound, self.laplace.log_moment, PRUNE_NATS)
        used = np.zeros(share.shape, bool)
        used[kept.order[kept.keep]] = True
        heaviest = int(share.argmax())
        return {
            "mixands": bound,
            "true_mixands": self.log_weight,
            "heaviest": shown(self.log_mixands[heaviest]),
            "looseness_nats": float(np.median(bound - self.log_weight)),
            "holds_1": float((bound >= self.log_weight - GRID_ERROR).mean()),
            "negligible_1": float((~used).mean()),
            "negligible_weight_1": float(share[~used].sum()),
        }


def simulate(runs: Sequence[int], seed: int, progress: Progress, only: str = "") -> Outcomes:
    """Sample one problem a run from the proposals of the rows that start with `only`.

    Returns
    -------
    {row/quantity: (R,)}, and row/mixands (R, M): shares of effective samples, or of bound: logarithms of the bounds
    beside the true weights; row/density, row/truth (R, P, P) for pictures
    """
    rows = chosen(ROWS, only)

    def one(run: int, tell: Progress) -> dict[str, Any]:
        case = Case(seed, run)
        values = {f"{name}/{q}": value for name, row in rows.items() for q, value in case.measure(row).items()}
        tell(1.0)
        return values

    return run_by_run(runs, progress, one)


def _row(variant: str, quantity: str) -> str:
    return f"given-mixture_exact@{variant}/{quantity}"


def figures(outcomes: Outcomes) -> dict[str, Estimate]:
    """Medians of divergences and of looseness over the problems, means of all else; comparisons of the proposals."""
    measured = {}
    for name, values in outcomes.items():
        if values.ndim == 1:
            average = Estimate.median if name.endswith("_nats") else Estimate.mean
            measured[name] = average(values)
    ess = {proposal: outcomes.get(_row(proposal, "mixands")) for proposal in PROPOSALS}
    naive, local, heavy = ess.values()
    if naive is not None and local is not None and heavy is not None:
        measured[_row("ingis", "beaten_1")] = Estimate.mean((np.maximum(local, heavy) > naive).mean(1))
        measured[_row("heavy_tail", "below_lagis_1")] = Estimate.mean((heavy < local).mean(1))
    return measured


def charts(outcomes: Outcomes) -> list[Chart]:
    """Fig. 7 and Fig. 8 for the first problem, and effective samples over all problems."""
    return [*_densities(outcomes), *_first_mixands(outcomes), *_all_mixands(outcomes)]


def _densities(outcomes: Outcomes) -> Iterator[Chart]:
    for variant in ROWS.values():
        density = outcomes.get(_row(variant, "density"))
        if density is not None:
            pictures = {"true density": outcomes[_row(variant, "truth")][0], variant: density[0]}
            yield contour_chart(f"First problem, 16 mixands: {variant.replace('_', ' ')}", pictures)
    heaviest = outcomes.get(_row("bound", "heaviest"))
    if heaviest is not None:
        yield contour_chart("First problem: its heaviest mixand", {"true density": heaviest[0]})


def _first_mixands(outcomes: Outcomes) -> Iterator[Chart]:
    ess = [(p, outcomes[_row(p, "mixands")][0]) for p in PROPOSALS if _row(p, "mixands") in outcomes]
    lines = [Series(proposal, np.arange(1.0, len(share) + 1), share, "points") for proposal, share in ess]
    if _row("bound", "mixands") in outcomes:
        bound, true = (outcomes[_row("bound", name)][0] for name in ("mixands", "true_mixands"))
        at, top = np.arange(1.0, len(bound) + 1), log_sum_exp(true)
        if lines:
            lines.append(Series("true weight", at, np.exp(true - top), "bars"))
        both = (Series("true", at, true - top, "points"), Series("bound", at, bound - top, "points"))
        yield Chart("First problem: weights and their bounds", "mixand", "logarithm of the weight, nats", both)
    if lines:
        yield Chart("First problem: effective samples", "mixand", "share of 500 samples", tuple(lines))


def _all_mixands(outcomes: Outcomes) -> Iterator[Chart]:
    shares = np.linspace(0.0, 1.0, 101)
    lines = [
        Series(p, shares, (outcomes[_row(p, "mixands")].reshape(-1, 1) < shares).mean(0))
        for p in PROPOSALS
        if _row(p, "mixands") in outcomes
    ]
    if lines:
        yield Chart(
            "Effective samples in all problems", "share of 500 samples", "share of mixands with fewer", (*lines,)
        )


#: A share of all is one but for rounding.
TIE = 1e-9

CLAIMS = (
    Claim.least("LAGIS and heavy tails have more effective samples than INGIS, on average over the mixands",
                "Section 5.2, Fig. 8(a)", _row("ingis", "ess_1"),
                [_row(proposal, "ess_1") for proposal in PROPOSALS[1:]]),
    Claim.above("LAGIS or heavy tails give the best effective sample size generally (judged: of nine in ten mixands)",
                "Section 5.2, Fig. 8(a)", 0.9, _row("ingis", "beaten_1")),
    Claim.above("heavy tails are sometimes worse than LAGIS (judged: in more than a twentieth of the mixands)",
                "Section 5.2, Fig. 8(a)", 0.05, _row("heavy_tail", "below_lagis_1")),
    Claim.order("divergence from the truth, from the least: heavy tails, LAGIS, INGIS, Laplace without sampling",
                "Fig. 7", *(_row(variant, "kld_nats") for variant in ("heavy_tail", "lagis", "ingis", "laplace"))),
    Claim.above("no mixand weighs more than its bound", "Eq. (56), Fig. 8(b)", 1.0 - TIE, _row("bound", "holds_1")),
    Claim.above("the bound is loose: in the median mixand by more than a factor e", "Section 5.2, Fig. 8(b)",
                1.0, _row("bound", "looseness_nats")),
    Claim.below("an extremely small bound tells negligible mixands: those 14 nats below weigh less than a thousandth",
                "Section 5.2, Fig. 8(b)", 1e-3, _row("bound", "negligible_weight_1")),
)  # fmt: skip

SCENARIO = Scenario(
    key="ahmed-proposals",
    title="What the mixands of a quotient of mixtures are sampled from",
    paper=f"{PAPER}, 5.2",
    shows="how many of its samples each proposal makes effective, and how tight the bound on a mixand's weight is",
    published={f"{row}/kld_nats": value for row, value in FIGURE_7.items()},
    default_runs=200,
    publication_runs=500,
    assumptions=(
        "the densities of Fig. 7 are only drawn: problems with 4 components a source are drawn like those of section "
        "5.1, and the one printed value stands beside the median",
        "assumed: 16 components of common information, four times those of a source, as in section 5.1",
        "a problem with a mixand that no component of the common information bounds is drawn again",
        "heavy tails: 5 equal shares at scales in geometric progression from 1 to the largest relative eigenvalue of "
        "the bound's covariance, between 2 and 8",
        "INGIS with alpha = 5; no mixand is left out before sampling, and none merged after it",
        "the true density, its mixands and their weights are taken on a grid of 100 x 100 cells over +-28",
        "share of effective samples: ess averages over the mixands alike, weighted_ess by their true weights",
    ),
    simulate=simulate,
    figures=figures,
    charts=charts,
    claims=CLAIMS,
    piece=10,
    rules=RULE_CHOICES,
    given=("common",),
    scores=functools.partial(scores, problem),
)
