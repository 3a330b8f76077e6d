"""What the README says of the published studies is what the claims and figures come to."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from track_fusion.scenarios import SCENARIOS
from track_fusion.scenarios.ahmed.random import IGS_SAMPLES
from track_fusion.study.judgement import judged_claims, judged_figures

README = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
STATEMENTS = re.sub(r"\s+", " ", README.partition("## Published studies, repeated")[2].partition("## More")[0])

#: Words of the README -> scenario, rows to run, runs (0: the scenario's own), claims by their beginnings -> verdict.
SAID = {
    "Covariance intersection with trace-optimal weights and common feedback always puts all weight on sensor 1": (
        "li2022-linear", ("kf-alone", "kf-ic", "kf-arithmetic_average", "kf-covariance_intersection"), 300,
        {"KF: the intersection is close to IC": "contradicts", "KF: the average is close to IC": "agrees"},
    ),
    "the criterion as printed collapses onto one estimate (`criterion: squared` does not)": (
        "chen2022-static", ("",), 0,
        {
            "t densities: MHDP-E, by the distances as printed": "contradicts",
            "generalised Gaussians: MHDP-E, by the distances as printed": "contradicts",
            "t densities: MHDP-E, by squared distances": "agrees",
            "generalised Gaussians: MHDP-E, by squared distances": "agrees",
        },
    ),
    "with three sensors the minimal Manhattan distance rules are best, as claimed": (
        "chen2022-dynamic-2", ("stf", "gstm"), 0,
        {
            "Student-t filter: MHDP-E has clearly lower errors": "agrees",
            "Gaussian-Student-t-mixture filter: MHDP-E has clearly lower errors": "agrees",
        },
    ),
    "with two that is undecided for the Student-t filter and contradicted for the mixture filter": (
        "chen2022-dynamic-1", ("stf", "gstm"), 0,
        {
            "Student-t filter: MHDP-E has clearly lower errors": "undecided",
            "Gaussian-Student-t-mixture filter: MHDP-E has clearly lower errors": "contradicts",
        },
    ),
    "that sampling beats single-Gaussian stand-ins with every number of samples is undecided over the 20 problems of "
    "the figure, for quotients of mixtures and for weighted exponential products alike": (
        "ahmed-random",
        ("given-mixture_exact@dls_", *(f"given-mixture_exact@igs_{s}" for s in IGS_SAMPLES), "given-mixture_exact@mmgd",
         "given-mixture_wep@dls_", *(f"given-mixture_wep@igs_{s}" for s in IGS_SAMPLES), "given-mixture_wep@foci"), 0,
        {
            "exact fusion: DLS and IGS improve on MMGD": "undecided",
            "WEP fusion: DLS and IGS improve on FOCI": "undecided",
        },
    ),
    "that the least variance of the arithmetic average is never above that of the geometric, whatever the two "
    "variables, is not so (two lognormals contradict it)": (
        "li2019-variables", ("",), 100,
        {
            "In Figs. 1 and 2 the least variance of the arithmetic average": "agrees",
            "So it is for any two variables": "contradicts",
        },
    ),
    "the harmonic mean density claims less than inverse covariance intersection and errs less, as claimed": (
        "sharma-network-2", ("",), 4000,
        {"HMD-GA reports the least": "agrees", "The actual error of HMD-GA is less than ICI's": "agrees"},
    ),
    "that it is always consistent, or always tighter, is not so": (
        "sharma-scalar", ("given-harmonic_mean", "kf-harmonic_mean"), 200,
        {"HMD-GA is consistent: variances 1 and 10": "contradicts", "HMD-GA is consistent: in this": "contradicts"},
    ),
}  # fmt: skip


#: Scenarios that take a minute at their own number of runs.
LONG = ("chen2022-dynamic-1", "chen2022-dynamic-2", "ahmed-random")


@pytest.mark.parametrize(
    "words", [pytest.param(words, marks=[pytest.mark.slow] * (said[0] in LONG)) for words, said in SAID.items()]
)
def test_claims_come_out_as_the_readme_says(words: str) -> None:
    key, rows, runs, wanted = SAID[words]
    scenario, measured = SCENARIOS[key], {}
    for only in rows:
        measured |= scenario.measure(runs or scenario.default_runs, 0, only=only)
    judged = {c["claim"]: c["verdict"] for c in judged_claims(scenario, measured)}
    for start, verdict in wanted.items():
        assert {v for claim, v in judged.items() if claim.startswith(start)} == {verdict}, start


@pytest.mark.parametrize("words", SAID)
def test_the_readme_says_it(words: str) -> None:
    assert words in STATEMENTS


def test_figures_come_out_as_the_readme_says() -> None:
    """Sensor 1 alone, the iterated corrector, the average and its weights; not the intersection, which is sensor 1."""
    assert "sensor 1 alone, the iterated corrector, the arithmetic average and its weights agree" in STATEMENTS
    scenario, measured = SCENARIOS["li2022-linear"], {}
    for only in ("kf-alone", "kf-ic", "kf-arithmetic_average", "kf-covariance_intersection"):
        measured |= scenario.measure(200, 0, only=only)
    verdicts = {f["name"]: f["verdict"] for f in judged_figures(scenario, measured) if f["published"] is not None}
    for name, verdict in verdicts.items():
        if name == "kf-covariance_intersection/position_armse_m":
            assert verdict == "contradicts"
        elif not name.startswith("kf-covariance_intersection"):
            assert verdict == "agrees", name
