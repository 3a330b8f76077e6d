"""The cubature Kalman filter: moments by the third-degree spherical-radial rule of 2 n equal points."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from track_fusion.filters.sigma_points import SigmaPointFilter, SigmaPoints


@lru_cache(maxsize=64)
def points(size: int) -> SigmaPoints:
    """Return the 2 n points at distance sqrt(n) along the axes, of equal weight: exact to the third degree."""
    offsets = np.sqrt(size) * np.concatenate([np.eye(size), -np.eye(size)])
    weight = np.full(2 * size, 0.5 / size)
    return SigmaPoints(offsets, weight, weight)


class Cubature(SigmaPointFilter):
    """The cubature Kalman filter.

    References     I. Arasaratnam, S. Haykin, Cubature Kalman filters, 2009.
    """

    def points(self, size: int) -> SigmaPoints:
        """Return the 2 n points for n axes."""
        return points(size)
