"""What really disturbs a simulated target and its measurements, in units of what the filters are told of."""

from __future__ import annotations

import dataclasses

import numpy as np

from track_fusion.linalg import Array
from track_fusion.random_streams import stream


@dataclasses.dataclass(frozen=True)
class Noise:
    """Gaussian noise, a share of it outliers of a larger variance; by default exactly as the filters are told.

    Attributes
    ----------
    scale : float            variance over that which the filters are told
    outlier_share : float    probability that a step's draw is an outlier, all its axes together
    outlier_scale : float    variance of an outlier over that of the rest

    References    Chen 2022 (69)-(71).
    """

    scale: float = 1.0
    outlier_share: float = 0.0
    outlier_scale: float = 1.0

    def draw(self, seed: int, run: int, role: str, steps: int, size: int) -> Array:
        """Draw a role's noise of one run, (steps, size), of unit covariance where `scale` is 1 and nothing an outlier.

        The first steps do not depend on how many are drawn.
        """
        draws = stream(seed, run, role).standard_normal((steps, size))
        scale = np.full(steps, self.scale)
        if self.outlier_share > 0:
            # A stream of its own: one that normals share would move with their number.
            hit = stream(seed, run, f"{role} outliers").random(steps) < self.outlier_share
            scale[hit] *= self.outlier_scale
        return np.asarray(np.sqrt(scale)[:, None] * draws)
