"""The Kalman filter, batched over leading axes."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from track_fusion.linalg import Array, logdet, matvec, symmetrise, transpose


@dataclasses.dataclass(frozen=True)
class Innovation:
    """What an update learned: residual (..., m), its covariance (..., m, m), NIS and log-likelihood (...)."""

    residual: Array
    cov: Array
    nis: Array

    @property
    def log_likelihood(self) -> Array:
        """Log of N(residual; 0, cov)."""
        size = self.residual.shape[-1]
        return np.asarray(-0.5 * (self.nis + logdet(self.cov) + size * np.log(2 * np.pi)))


def predict(mean: Array, cov: Array, transition: Array, noise: Array) -> tuple[Array, Array]:
    """Predict x' = F x + w, w ~ N(0, Q).

    Parameters
    ----------
    mean : (..., n)
    cov : (..., n, n)
    transition, noise : (..., n, n)    F and Q

    Returns
    -------
    mean (..., n), cov (..., n, n)
    """
    return matvec(transition, mean), symmetrise(transition @ cov @ transpose(transition) + noise)


def update(mean: Array, cov: Array, z: Array, matrix: Array, noise: Array) -> tuple[Array, Array, Innovation]:
    """Condition on z = H x + v, v ~ N(0, R), in Joseph's form, which keeps the covariance definite.

    Parameters
    ----------
    mean : (..., n)
    cov : (..., n, n)
    z : (..., m)
    matrix : (..., m, n)    H
    noise : (..., m, m)     R

    Returns
    -------
    mean (..., n), cov (..., n, n), Innovation
    """
    residual = z - matvec(matrix, mean)
    cross = matrix @ cov
    spread = symmetrise(cross @ transpose(matrix) + noise)
    gain = transpose(np.asarray(np.linalg.solve(spread, cross), np.float64))
    keep = np.eye(mean.shape[-1]) - gain @ matrix
    posterior = symmetrise(keep @ cov @ transpose(keep) + gain @ noise @ transpose(gain))
    nis = (residual * np.linalg.solve(spread, residual[..., None])[..., 0]).sum(-1)
    return mean + matvec(gain, residual), posterior, Innovation(residual, spread, np.asarray(nis))


def update_joint(
    mean: Array, cov: Array, zs: Sequence[Array], matrices: Sequence[Array], noises: Sequence[Array]
) -> tuple[Array, Array, Innovation]:
    """Condition on several sensors at once: the joint likelihood of Li 2022 (46), iterated corrector (IC).

    Parameters
    ----------
    mean, cov : as for :func:`update`
    zs : sequence of (..., m_i)
    matrices : sequence of (m_i, n)
    noises : sequence of (m_i, m_i)

    Returns
    -------
    mean (..., n), cov (..., n, n), Innovation of the stacked measurement
    """
    noise = np.zeros((sum(len(r) for r in noises),) * 2)
    at = 0
    for r in noises:
        noise[at : at + len(r), at : at + len(r)] = r
        at += len(r)
    return update(mean, cov, np.concatenate(zs, -1), np.concatenate(matrices), noise)
