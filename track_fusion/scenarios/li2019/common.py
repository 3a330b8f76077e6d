"""What the scenarios of Li et al. 2019, arithmetic and geometric averages, share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from track_fusion.densities.log_domain import normalised
from track_fusion.densities.mixture.mixture import Mixture, log_pdf, moments
from track_fusion.linalg import Array
from track_fusion.metrics.accuracy import Estimate
from track_fusion.rules import RULES, FusedTracks, SourceTracks
from track_fusion.study.rows import Outcomes, Progress, chosen
from track_fusion.study.rule_choice import RuleChoice, check_needs

PAPER = (
    "Li et al., Second Order Statistics Analysis and Comparison between Arithmetic and Geometric Average Fusion, 2019, "
)


# Rows in which nothing is random.


def exact_samples(
    rows: Mapping[str, Callable[[], Mapping[str, float]]], runs: Sequence[int], progress: Progress, only: str
) -> Outcomes:
    """Work out the rows whose names start with `only`; every run has the same numbers, (R,) each.

    Parameters
    ----------
    rows : mapping    row name -> function that gives {quantity: value}
    """
    found: Outcomes = {}
    wanted = chosen(rows, only)
    for done, (row, measure) in enumerate(wanted.items(), 1):
        found |= {f"{row}/{quantity}": np.full(len(runs), float(value)) for quantity, value in measure().items()}
        progress(done / len(wanted))
    return found


def exact_figures(outcomes: Outcomes) -> dict[str, Estimate]:
    """Figures of samples in which nothing is random."""
    return {name: Estimate.exact(values[0]) for name, values in outcomes.items()}


def fuse(choice: RuleChoice, tracks: SourceTracks) -> FusedTracks:
    """Fuse by any rule that can do with the tracks alone.

    Raises
    ------
    ParameterError    the rule needs something beside the tracks
    """
    check_needs([choice])
    return RULES[choice.key].fuse(tracks, choice.params)


# Mixtures of one axis.


def scalar_mixture(weight: Array, mean: Array, variance: Array) -> Mixture:
    """Make mixtures of one axis, (..., C) each."""
    return Mixture(np.asarray(weight), np.asarray(mean)[..., None], np.asarray(variance)[..., None, None])


def as_tracks(parts: Mixture) -> SourceTracks:
    """Make tracks of mixtures (..., K, C)."""
    return SourceTracks(*moments(parts), mixture=parts)


def intensity(mixture: Mixture, x: Array) -> Array:
    """Intensity of mixtures (..., C) of one axis at points (S,): (..., S)."""
    return np.asarray(np.exp(log_pdf(mixture, x[:, None])))


def expected_number(parts: Mixture) -> Array:
    """Unweighted mean of the expected numbers of targets of K mixtures (..., K, C): (...)."""
    return np.asarray(parts.weight.sum(-1).mean(-1))


def fused_intensity(choice: RuleChoice, parts: Mixture) -> Mixture:
    """Fuse K mixtures (..., K, C) by any rule, scaled to the arithmetic average of their expected numbers of targets.

    A rule that gives a Gaussian is a mixture of one component.
    """
    fused = fuse(choice, as_tracks(parts))
    where = fused.mixture
    if where is None:
        where = Mixture(np.ones((*fused.mean.shape[:-1], 1)), fused.mean[..., None, :], fused.cov[..., None, :, :])
    where = where.normalised
    return Mixture(expected_number(parts)[..., None] * where.weight, where.mean, where.cov)


def exact_geometric(parts: Mixture, x: Array) -> Array:
    """Unweighted geometric average of K mixtures (..., K, C) without the approximation (49), point by point.

    Parameters
    ----------
    parts : Mixture
    x : (S,)    evenly spaced, wide enough to hold all mass

    Returns
    -------
    (..., S)    intensity, of the arithmetic average of the expected numbers of targets
    """
    shape = normalised(log_pdf(parts.normalised, x[:, None]).mean(-2))
    return np.asarray(expected_number(parts)[..., None] * shape / (x[1] - x[0]))
