"""The Kalman filter as textbooks write it, P - K S K': nothing of the package, other roundings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Learned(NamedTuple):
    """Normalised innovation squared, and log-likelihood of the measurement, (...)."""

    nis: Floats
    log_likelihood: Floats


def predict(mean: Floats, cov: Floats, f: Floats, q: Floats) -> tuple[Floats, Floats]:
    """Predict x' = F x + w: mean (..., n), cov (..., n, n)."""
    return (f @ mean[..., None])[..., 0], f @ cov @ np.swapaxes(f, -1, -2) + q


def update(mean: Floats, cov: Floats, z: Floats, h: Floats, r: Floats) -> tuple[Floats, Floats, Learned]:
    """Condition on z = H x + v, z (..., m)."""
    transposed = np.swapaxes(h, -1, -2)
    spread = h @ cov @ transposed + r
    gain = cov @ transposed @ np.linalg.inv(spread)
    residual = z - (h @ mean[..., None])[..., 0]
    nis = (residual * np.linalg.solve(spread, residual[..., None])[..., 0]).sum(-1)
    log_likelihood = -0.5 * (nis + np.linalg.slogdet(2.0 * np.pi * spread)[1])
    moved = mean + (gain @ residual[..., None])[..., 0]
    return moved, cov - gain @ spread @ np.swapaxes(gain, -1, -2), Learned(nis, log_likelihood)
