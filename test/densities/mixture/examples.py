"""Mixtures that several tests take for examples, and moments of a quotient's mixands by a fine grid."""

from __future__ import annotations

import numpy as np

from track_fusion.densities.mixture.mixture import Mixture, log_pdf
from track_fusion.densities.mixture.quotient import Quotient
from track_fusion.densities.on_grid import grid


def draw(rng: np.random.Generator, *lead: int, count: int = 3, n: int = 2, spread: float = 3.0) -> Mixture:
    root = rng.normal(size=(*lead, count, n, n + 2))
    weight = rng.uniform(0.2, 1.0, size=(*lead, count))
    return Mixture(
        weight / weight.sum(-1, keepdims=True),
        spread * rng.normal(size=(*lead, count, n)),
        root @ np.swapaxes(root, -1, -2),
    )


def scalar(*parts: tuple[float, float, float]) -> Mixture:
    weight, mean, cov = np.array(parts).T
    return Mixture(weight, mean[:, None], cov[:, None, None])


FIRST = scalar((0.4, -1.0, 1.0), (0.6, 2.0, 2.0))
SECOND = scalar((0.7, 0.0, 1.5), (0.3, 4.0, 1.0))
COMMON = scalar((0.5, -2.0, 6.0), (0.5, 3.0, 4.0))


def mixand_moments(quotient: Quotient, z: int) -> tuple[float, float, float]:
    """Integral, mean and variance of one scalar mixand, its weight included, by the midpoint rule on a fine grid."""
    one = quotient.take(np.array([z]))
    weight, mean, cov = one.numerator
    points = grid(np.array([-80.0]), np.array([80.0]), 8000)
    density = np.exp(weight[0] + log_pdf(Mixture(np.ones(1), mean, cov), points) - quotient.log_denominator(points))
    total, x = density.sum() * 160.0 / 8000, points[:, 0]
    centre = density @ x / density.sum()
    return float(total), float(centre), float(density @ (x - centre) ** 2 / density.sum())
