"""How what a scenario measures is judged against the published figures and claims."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from decimal import Decimal
from typing import Any, NamedTuple

import numpy as np

from track_fusion.linalg import Array
from track_fusion.metrics.accuracy import Estimate
from track_fusion.metrics.certainty import LEAST_RUNS, TAIL, surely_positive
from track_fusion.study.claim import Claim
from track_fusion.study.scenario import Printed, Scenario

AGREES, CONTRADICTS, UNDECIDED = "agrees", "contradicts", "undecided"
#: Of a figure beside which nothing is printed; of what agrees whatever is measured.
NOT_GIVEN, BY_CONSTRUCTION = "not given", "by construction"
#: A figure agrees within so many standard deviations of the difference.
AGREEMENT_SIGMAS = 3.0
#: A margin that is a smaller share of the figures behind it is rounding, and counts as a tie.
ROUNDING = 1e-12


class Judgement(NamedTuple):
    """A verdict, and in a few words why or with what reservation ("" = it speaks for itself)."""

    verdict: str
    reason: str = ""


def judged_figures(scenario: Scenario, measured: Mapping[str, Estimate]) -> list[dict[str, Any]]:
    """Set measured beside published, one entry a figure: name, value, standard_error, published, verdict, reason."""
    return [
        {
            "name": name,
            "value": estimate.value,
            "standard_error": None if math.isnan(estimate.standard_error) else estimate.standard_error,
            "published": scenario.published.get(name),
            **judged_figure(scenario, name, measured)._asdict(),
        }
        for name, estimate in measured.items()
    ]


def judged_claims(scenario: Scenario, measured: Mapping[str, Estimate]) -> list[dict[str, Any]]:
    """Judge the claims whose figures were measured: claim, source, verdict, reason, evidence (the figures)."""
    return [
        {
            "claim": claim.text,
            "source": claim.source,
            **judged_claim(claim, [measured[n] for n in claim.needs])._asdict(),
            "evidence": {n: measured[n].value for n in claim.needs},
        }
        for claim in scenario.claims
        if all(name in measured for name in claim.needs)
    ]


# Claims.


def judged_claim(claim: Claim, figures: Sequence[Estimate]) -> Judgement:
    """Judge a claim by its margins.

    Returns
    -------
    "agrees" (every margin is positive), "contradicts" (one is negative, or a tie in every run, beyond chance),
    "undecided" (neither, or fewer than LEAST_RUNS runs), "by construction" (agrees, as no result could help)

    Notes    The figures come from the same runs, so that a margin has a value without each of the runs and a
             pseudo-value of each (jackknife), in which what the runs have in common cancels: comparisons are paired.
             The mean of the pseudo-values is judged by surely_positive; that one of M margins is negative, at 1/M of
             its probability of error. Where nothing is random the margins themselves decide.
    """
    unknown = [e for e in figures if e.left_out is None and e.standard_error != 0.0]
    if unknown:
        return Judgement(UNDECIDED, "a single run" if unknown[0].runs == 1 else "its error is not known")
    runs = {len(e.left_out) for e in figures if e.left_out is not None}
    if len(runs) > 1:
        return Judgement(UNDECIDED, "figures of different runs")
    points = _points(figures, max(runs, default=0))
    with np.errstate(invalid="ignore", divide="ignore"):
        margins = np.array([np.broadcast_to(m, points.shape[1]) for m in claim.margins(*points)], float)
    if not np.isfinite(margins).all():
        return Judgement(UNDECIDED, "not defined without some of the runs")
    margins[(np.abs(margins) <= ROUNDING * np.abs(points).max()).all(1)] = 0.0
    judgement = _by_runs(margins) if runs else _at_once(margins)
    if judgement.verdict == AGREES and claim.by_construction:
        return Judgement(BY_CONSTRUCTION, claim.by_construction)
    return judgement


def _points(figures: Sequence[Estimate], runs: int) -> Array:
    """Figures as measured, without each of the runs, and as far off as unanimous runs allow: (F, 1 + R + 1)."""
    lacking = [np.full(runs, e.value) if e.left_out is None else e.left_out for e in figures]
    return np.array([[e.value, *left, e.value + e.unseen] for e, left in zip(figures, lacking, strict=True)])


def _at_once(margins: Array) -> Judgement:
    if (margins > 0.0).all():
        return Judgement(AGREES)
    return Judgement(CONTRADICTS, "" if (margins < 0.0).any() else "a tie")


def _by_runs(margins: Array) -> Judgement:
    """Judge margins at the points of _points, (M, 1 + R + 1)."""
    measured, left_out, unseen = margins[:, 0], margins[:, 1:-1], margins[:, -1]
    runs = left_out.shape[1]
    if runs < LEAST_RUNS:
        return Judgement(UNDECIDED, f"fewer than {LEAST_RUNS} runs")
    pseudo = runs * measured[:, None] - (runs - 1) * left_out
    if all(surely_positive(values) for values in pseudo) and (unseen > 0.0).all():
        return Judgement(AGREES)
    if any(surely_positive(-values, TAIL / len(pseudo)) for values in pseudo[unseen < 0.0]):
        return Judgement(CONTRADICTS)
    if not margins.any(1).all():
        return Judgement(CONTRADICTS, "a tie in every run")
    return Judgement(UNDECIDED, "too close to tell from these runs")


# Figures.


def judged_figure(scenario: Scenario, name: str, measured: Mapping[str, Estimate]) -> Judgement:
    """Judge one figure.

    Returns
    -------
    "agrees" (the difference is within 3 standard deviations, Monte Carlo error here and spread of one
    table of the paper's own run count together, and the rounding of the print), "contradicts" (it is not; the reason
    says where it stands to every other row of its table as published), "undecided" (a single run, whose error is not
    known), "by construction" (it agrees because an assumption was chosen so) or "not given"
    """
    published, estimate = scenario.published.get(name), measured[name]
    if published is None:
        return Judgement(NOT_GIVEN)
    if math.isnan(estimate.standard_error):
        return Judgement(UNDECIDED, "a single run")
    error = math.hypot(estimate.standard_error, estimate.spread(scenario.published_runs))
    if abs(estimate.value - published) <= AGREEMENT_SIGMAS * error + rounding(published):
        return Judgement(BY_CONSTRUCTION, "chosen so") if name in scenario.chosen else Judgement(AGREES)
    return Judgement(CONTRADICTS, "in the order published" if _is_ordered(scenario, name, measured) else "")


def _is_ordered(scenario: Scenario, name: str, measured: Mapping[str, Estimate]) -> bool:
    """Tell whether a figure stands to every other row of its table as published.

    A tie here where the paper has none is not its order; a tie of the paper orders nothing.
    """
    published, value, quantity = scenario.published[name], measured[name].value, name.rpartition("/")[2]
    rows = [n for n in measured if n.endswith(f"/{quantity}") and scenario.published.get(n, published) != published]
    return bool(rows) and all((value - measured[n].value) * (published - scenario.published[n]) > 0 for n in rows)


def rounding(published: float) -> float:
    """Half a unit of the last digit of the print, which is what stands in the table here; an int counts as exact."""
    if isinstance(published, int):
        return 0.0
    printed = published.text if isinstance(published, Printed) else repr(published)
    exponent = Decimal(printed).as_tuple().exponent
    assert isinstance(exponent, int)
    return 0.5 * 10.0**exponent
