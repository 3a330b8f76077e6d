"""The cubature Kalman filter on roots of covariances, for states whose variances span more than 1e8.

A root L, (..., n, n) lower triangular with L L' = P, has half the digits' range of P: where P as a matrix of
doubles is no longer definite, the root still is.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from track_fusion.filters.base import Density, Innovation
from track_fusion.filters.cubature import points
from track_fusion.filters.sigma_points import expected_measurement
from track_fusion.linalg import Array, cholesky, matvec, solve, symmetrise, transpose
from track_fusion.models.base import Sensor, Transition


@dataclasses.dataclass(frozen=True)
class GaussianRoot:
    """A Gaussian: mean (..., n) and lower triangular root (..., n, n) of its covariance."""

    mean: Array
    root: Array

    @property
    def moments(self) -> tuple[Array, Array]:
        """Mean (..., n) and covariance (..., n, n)."""
        return self.mean, symmetrise(self.root @ transpose(self.root))


def triangular_root(wide: Array) -> Array:
    """Return L lower triangular, diagonal >= 0, with L L' = A A': (..., n, k >= n) -> (..., n, n), by QR."""
    upper = np.asarray(np.linalg.qr(transpose(wide), mode="r"), np.float64)
    sign = np.where(np.diagonal(upper, axis1=-2, axis2=-1) < 0.0, -1.0, 1.0)
    return np.asarray(transpose(upper) * sign[..., None, :])


def _scaled(deviations: Array) -> Array:
    """Columns whose outer products sum to the covariance of equally weighted deviations (..., P, k)."""
    return np.asarray(transpose(deviations) / np.sqrt(deviations.shape[-2]))


def _beside(a: Array, b: Array) -> Array:
    """Put (..., n, k) and (..., n, l) side by side, broadcasting b."""
    return np.concatenate([a, np.broadcast_to(b, (*a.shape[:-2], *b.shape[-2:]))], -1)


class SquareRootCubature:
    """The cubature Kalman filter on roots.

    References     I. Arasaratnam, S. Haykin, Cubature Kalman filters, 2009, appendix B.
    """

    def begin(self, mean: Array, cov: Array) -> GaussianRoot:
        """Return the Gaussian; a LinAlgError if its covariance is not positive definite."""
        return GaussianRoot(mean, cholesky(cov))

    def adopt(self, state: GaussianRoot, density: Density) -> GaussianRoot:
        """Return the Gaussian with the moments of the density."""
        return self.begin(*density.moments)

    def predict(self, state: GaussianRoot, transition: Transition) -> GaussianRoot:
        """Predict x' = f(x) + w.

        Parameters
        ----------
        state : GaussianRoot       (..., n)
        transition : Transition    its noise_factor is used
        """
        rule = points(state.mean.shape[-1])
        moved = transition.advance(rule.of(state.mean, state.root))
        shift = rule.mean(moved - moved[..., :1, :])
        deviation = moved - moved[..., :1, :] - shift[..., None, :]
        root = triangular_root(_beside(_scaled(deviation), transition.noise_factor(state.mean)))
        return GaussianRoot(moved[..., 0, :] + shift, root)

    def update(self, state: GaussianRoot, z: Array, sensor: Sensor) -> tuple[GaussianRoot, Innovation]:
        """Condition on z = h(x) + v.

        Parameters
        ----------
        state : GaussianRoot    (..., n)
        z : (..., m)
        sensor : Sensor         R positive definite

        Notes    One QR of [[Z, R^1/2], [X, 0]], (m + n) x (2 n + m), gives the innovation's root, the gain and the
                 posterior's root.
        """
        mean, (n, m) = state.mean, (state.mean.shape[-1], z.shape[-1])
        sigma = points(n).of(mean, state.root)
        expected, seen = expected_measurement(mean, sigma, sensor, points(n))
        above = _beside(_scaled(seen), cholesky(sensor.noise))
        below = _beside(_scaled(sigma - mean[..., None, :]), np.zeros((n, m)))
        joint = triangular_root(np.concatenate([above, below], -2))
        spread_root, cross, left = joint[..., :m, :m], joint[..., m:, :m], joint[..., m:, m:]
        residual = sensor.residual(z, expected)
        white = solve(spread_root, residual[..., None])[..., 0]
        spread = symmetrise(spread_root @ transpose(spread_root))
        return GaussianRoot(mean + matvec(cross, white), left), Innovation(residual, spread)
