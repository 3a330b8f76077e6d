"""Sharma et al., section 5.2, Fig. 2: two Gaussian mixtures fused by sampling."""

from __future__ import annotations

from functools import partial

import numpy as np

from track_fusion.densities.mixture.mean_density import Kind
from track_fusion.densities.mixture.mixture import Mixture, log_pdf
from track_fusion.linalg import Array
from track_fusion.scenarios.sharma import PAPER
from track_fusion.scenarios.sharma import densities as shared
from track_fusion.scenarios.sharma.densities import COVS, GMD_S, HALF, HMD_GA, HMD_S, Pair
from track_fusion.study.chart import Chart, Contours
from track_fusion.study.claim import Claim
from track_fusion.study.rows import Outcomes
from track_fusion.study.rule_choice import RuleChoice
from track_fusion.study.scenario import Scenario

#: The two mixtures after (76); the second is printed as another p^1.
PAIR = Pair(
    Mixture(
        np.array([[0.3, 0.7], [0.4, 0.6]]),
        np.array([[[-0.5, 3.0], [2.0, 0.3]], [[-1.5, 1.0], [3.0, -4.0]]]),
        np.stack([COVS, COVS]),
    )
)
RULE_CHOICES = (
    GMD_S,
    HMD_S,
    RuleChoice.of("mixture_geometric", criterion="given", weights=HALF),
    RuleChoice.of("covariance_intersection", criterion="given", weights=HALF),
    HMD_GA,
)
ROWS = {f"given-{choice.name}": PAIR.by_rule(choice) for choice in RULE_CHOICES} | {
    "given-geometric_mean_sampling@grid": PAIR.by_grid("geometric"),
    "given-harmonic_mean@grid": PAIR.by_grid("harmonic"),
}
#: Where contours are drawn, and at which shares of the highest density.
X, Y = np.linspace(-6.0, 6.0, 61), np.linspace(-10.0, 7.0, 86)
LEVELS = (0.05, 0.2, 0.5, 0.8)


def charts(outcomes: Outcomes) -> list[Chart]:
    """Fig. 2: the sources, and each mean density exact and by one fusion of samples."""
    plane = np.stack(np.meshgrid(X, Y), -1).reshape(-1, 2)
    sources = tuple(_contours(f"p{i + 1}", log_pdf(PAIR.parts.at(i), plane)) for i in range(2))
    panels = [Chart("Sources", "x", "y", contours=sources, equal=True)]
    kinds: dict[str, tuple[Kind, RuleChoice]] = {"GMD": ("geometric", GMD_S), "HMD": ("harmonic", HMD_S)}
    for title, (kind, choice) in kinds.items():
        row = f"given-{choice.name}"
        if f"{row}/weight" in outcomes:
            drawn = Mixture(*(outcomes[f"{row}/{column}"][0] for column in ("weight", "means", "covs")))
            lines = _contours(title, PAIR.log_mean(plane, kind)), _contours(f"{title}-S", log_pdf(drawn, plane))
            panels.append(Chart(f"{title}, exact and by samples (one run)", "x", "y", contours=lines, equal=True))
    return panels


def _contours(label: str, log_density: Array) -> Contours:
    """Contours at shares of the highest value on the plane, from logarithms (S,)."""
    z = np.exp(log_density - log_density.max()).reshape(len(Y), len(X))
    return Contours(label, X, Y, z.round(4), LEVELS)


SCENARIO = Scenario(
    key="sharma-mixtures",
    title="Two Gaussian mixtures, fused by sampling",
    paper=f"{PAPER}, 5.2, Fig. 2",
    shows="the geometric and the harmonic mean of mixtures, sampled beside exact, and what Gaussian stand-ins lose",
    default_runs=200,
    publication_runs=1000,
    assumptions=(
        "assumed: weights 1/2 in every fusion",
        "the second density printed as p^1 is p^2",
        "a run is one fusion by 5000 samples in all, drawn from the balanced mixture of both densities; each pair of "
        "components gets its share of them: choosing sample by sample, as in (74), biases",
        "@grid: the density itself by summation",
        "covariance_intersection, harmonic_mean: of the Gaussians with the mixtures' moments",
        "divergence: of the exact harmonic mean density from the fused mixture, or the Gaussian with the moments",
    ),
    simulate=partial(shared.simulate, ROWS),
    figures=partial(shared.figures, ROWS),
    charts=charts,
    claims=(
        Claim.order("The uncertainty of HMD-S is less than that of GMD-S: by samples.", "5.2, Fig. 2",
                    "given-harmonic_mean@sampled/determinant_1", "given-geometric_mean_sampling/determinant_1"),
        Claim.order(
            "The uncertainty of the harmonic mean is less than that of the geometric: the densities themselves.",
            "5.2, Fig. 2", "given-harmonic_mean@grid/determinant_1",
            "given-geometric_mean_sampling@grid/determinant_1",
        ),
    ),
    piece=50,
    rules=RULE_CHOICES,
    scores=PAIR.scores,
)  # fmt: skip
