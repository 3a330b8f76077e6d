"""What the scenarios of Li et al. 2019, arithmetic and geometric averages, share."""

from __future__ import annotations

import numpy as np

from track_fusion.densities.log_domain import normalised
from track_fusion.densities.mixture.mixture import Mixture, log_pdf
from track_fusion.linalg import Array
from track_fusion.rules import SourceTracks
from track_fusion.study.rule_choice import RuleChoice


def scalar_mixture(weight: Array, mean: Array, variance: Array) -> Mixture:
    """Make mixtures of one axis, (..., C) each."""
    return Mixture(np.asarray(weight), np.asarray(mean)[..., None], np.asarray(variance)[..., None, None])


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
    density = choice.fuse(SourceTracks.of(parts)).density.normalised
    return Mixture(expected_number(parts)[..., None] * density.weight, density.mean, density.cov)


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
