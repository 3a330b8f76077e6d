"""Harmonic mean of K Gaussians, f proportional to 1 / sum of w_i / p_i: the denominator replaced by one Gaussian.

Times the product of all p_j the sum is a mixture: of the products q_i of all but one, each with the weight w_i c_i, c_i
the integral of that product. With N(m, M) of the mixture's moments in its place, P^-1 = sum of P_j^-1 - M^-1. For
two Gaussians q_i is the other one, c_i is 1, and this is HMD-GA of Sharma (31)-(35).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from track_fusion.densities.log_domain import log_of, normalised
from track_fusion.linalg import Array, inverse, keep_sole, logdet, matvec, outer, solve, symmetrise, transpose

#: A weight that is not zero is no less than this, so that what it weighs is not forgotten.
LEAST = float(np.finfo(float).tiny)


@dataclasses.dataclass(frozen=True)
class HarmonicMean:
    """K Gaussians prepared, for a batch, in axes in which the sum of their covariances is the unit matrix.

    Attributes
    ----------
    given : (B, K, n), (B, K, n, n)       the Gaussians
    lower : (B, n, n)                     x = x_1 + L y
    naive : (B, n)                        a, the mean of the product of all
    inverse : (B, n, n)                   A^-1, its covariance
    others : (B, K, n, n)                 Q_i, the covariance of the product of all but i
    means : (B, K, n)                     m_i - a, its mean
    drag : (B, K, n, n)                   Q_i P_i^-1
    log_scale : (B, K)                    log c_i, up to what is common to all i
    """

    given: tuple[Array, Array]
    lower: Array
    naive: Array
    inverse: Array
    others: Array
    means: Array
    drag: Array
    log_scale: Array

    @classmethod
    def of(cls, mean: Array, cov: Array) -> HarmonicMean:
        """Prepare Gaussians of mean (B, K, n), cov (B, K, n, n), K > 1.

        Raises
        ------
        LinAlgError    a covariance is singular
        """
        lower = np.linalg.cholesky(cov.sum(1))
        whiten = np.linalg.inv(lower)[:, None]
        white = symmetrise(whiten @ cov @ transpose(whiten))
        points = matvec(whiten, mean - mean[:, :1])
        info = inverse(white)
        total = inverse(info.sum(1))
        naive = matvec(total, matvec(info, points).sum(1))
        # Sums of all but one: to subtract the one would lose the digits of the others beside a sharp one.
        but_one = 1.0 - np.eye(mean.shape[1])
        others = inverse(np.einsum("kl,blij->bkij", but_one, info))
        drag = others @ info
        means = -matvec(drag, points - naive[:, None])
        gap = points[:, None] - naive[:, None, None] - means[:, :, None]  # x_j - m_i
        square = (gap * np.einsum("bjxy,bijy->bijx", info, gap)).sum(-1)
        log_scale = 0.5 * (logdet(others) + logdet(white) - (but_one * square).sum(-1))
        return cls((mean, cov), lower, naive, total, others, means, drag, log_scale)

    def shares(self, weights: Array) -> Array:
        """Weights of the mixture, (B, K), from those of the harmonic mean, (B, K) of sum 1."""
        return normalised(log_of(weights) + self.log_scale)

    def weights(self, shares: Array) -> Array:
        """Weights of the harmonic mean, (B, K), from those of the mixture."""
        omega = np.where(shares > 0.0, np.maximum(normalised(log_of(shares) - self.log_scale), LEAST), 0.0)
        return np.asarray(omega)

    def at(self, shares: Array) -> tuple[Array, Array]:
        """Mean (B, n) and covariance (B, n, n) at weights of the mixture, (B, K).

        With N = M - A^-1, a sum of positive parts, P = A^-1 + A^-1 N^-1 A^-1: nothing is subtracted.
        """
        share = shares[..., None]
        centre = (share * self.means).sum(1)
        spread = self.drag @ self.inverse[:, None] + outer(self.means - centre[:, None])
        rest = symmetrise((share[..., None] * spread).sum(1))
        root = solve(rest, self.inverse)  # N^-1 A^-1
        cov = self.lower @ symmetrise(self.inverse + self.inverse @ root) @ transpose(self.lower)
        shift = matvec(transpose(root), -centre)
        mean, cov = self.given[0][:, 0] + matvec(self.lower, self.naive + shift), symmetrise(cov)
        keep_sole(mean, cov, *self.given, shares)
        return mean, cov
