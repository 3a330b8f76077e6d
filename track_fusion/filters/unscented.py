"""The unscented Kalman filter: moments by 2 n + 1 sigma points."""

from __future__ import annotations

import dataclasses
from functools import lru_cache

import numpy as np

from track_fusion.filters.sigma_points import SigmaPointFilter, SigmaPoints
from track_fusion.params import Params, param


@dataclasses.dataclass(frozen=True)
class UnscentedParams(Params):
    """Where the sigma points lie and what they weigh."""

    alpha: float = param(1.0, "scale of the points' distance from the mean", low=0.0, high=10.0, strict=True)
    beta: float = param(0.0, "extra weight of the centre in covariances; 2 suits a Gaussian at small alpha", low=0.0)
    kappa: float = param(1.0, "points lie at alpha sqrt(n + kappa) standard deviations; 0 leaves the centre out")


@lru_cache(maxsize=64)
def points(size: int, params: UnscentedParams) -> SigmaPoints:
    """Return the centre and 2 n points along the axes.

    Raises
    ------
    ValueError    n + kappa is not positive
    """
    if size + params.kappa <= 0:
        raise ValueError(f"The 'kappa' parameter must exceed -n = {-size}. Got {params.kappa:g}.")
    square = params.alpha**2 * (size + params.kappa)
    arms = np.sqrt(square) * np.concatenate([np.eye(size), -np.eye(size)])
    mean_weight = np.full(2 * size + 1, 0.5 / square)
    mean_weight[0] = 1.0 - size / square
    cov_weight = mean_weight.copy()
    cov_weight[0] += 1.0 - params.alpha**2 + params.beta
    return SigmaPoints(np.concatenate([np.zeros((1, size)), arms]), mean_weight, cov_weight)


@dataclasses.dataclass(frozen=True)
class Unscented(SigmaPointFilter):
    """The unscented Kalman filter; covariances are definite for certain only if no weight is negative.

    References     S. J. Julier, J. K. Uhlmann, Unscented filtering and nonlinear estimation, 2004.
    """

    params: UnscentedParams = UnscentedParams()

    def points(self, size: int) -> SigmaPoints:
        """Return the 2 n + 1 points for n axes."""
        return points(size, self.params)
