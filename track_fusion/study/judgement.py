"""How what a scenario measures is judged against the published figures and claims."""

from __future__ import annotations

import math
from collections.abc import Mapping
from decimal import Decimal
from typing import Any

from track_fusion.metrics.accuracy import Estimate
from track_fusion.study.scenario import Printed, Scenario

#: A figure agrees within so many standard deviations of the difference.
AGREEMENT_SIGMAS = 3.0


def judged_figures(scenario: Scenario, measured: Mapping[str, Estimate]) -> list[dict[str, Any]]:
    """Set measured beside published, one entry a figure: name, value, standard_error, published, verdict."""
    return [
        {
            "name": name,
            "value": estimate.value,
            "standard_error": None if math.isnan(estimate.standard_error) else estimate.standard_error,
            "published": scenario.published.get(name),
            "verdict": verdict(scenario, name, measured),
        }
        for name, estimate in measured.items()
    ]


def judged_claims(scenario: Scenario, measured: Mapping[str, Estimate]) -> list[dict[str, Any]]:
    """Judge the claims whose figures were measured: claim, source, verdict, evidence (the figures)."""
    return [
        {
            "claim": claim.text,
            "source": claim.source,
            "verdict": "agrees" if claim.holds(*(measured[n] for n in claim.needs)) else "does not reproduce",
            "evidence": {n: measured[n].value for n in claim.needs},
        }
        for claim in scenario.claims
        if all(name in measured for name in claim.needs)
    ]


def verdict(scenario: Scenario, name: str, measured: Mapping[str, Estimate]) -> str:
    """Judge one figure.

    Returns
    -------
    "agrees" (the difference is within 3 standard deviations, Monte Carlo error here and spread of one
    table of the paper's own run count together, and the rounding of the print), "ordering only" (it stands to every
    other row of its table as published), "does not reproduce" or "not given"
    """
    published, estimate = scenario.published.get(name), measured[name]
    if published is None or math.isnan(estimate.standard_error):
        return "not given"
    error = math.hypot(estimate.standard_error, estimate.spread(scenario.published_runs))
    if abs(estimate.value - published) <= AGREEMENT_SIGMAS * error + rounding(published):
        return "agrees"
    quantity = name.rpartition("/")[2]
    rows = [n for n in measured if n.endswith(f"/{quantity}") and scenario.published.get(n, published) != published]
    # A tie here where the paper has none is not its order; a tie of the paper orders nothing.
    kept = all((estimate.value - measured[n].value) * (published - scenario.published[n]) > 0 for n in rows)
    return "ordering only" if rows and kept else "does not reproduce"


def rounding(published: float) -> float:
    """Half a unit of the last digit of the print, which is what stands in the table here; an int counts as exact."""
    if isinstance(published, int):
        return 0.0
    printed = published.text if isinstance(published, Printed) else repr(published)
    exponent = Decimal(printed).as_tuple().exponent
    assert isinstance(exponent, int)
    return 0.5 * 10.0**exponent
