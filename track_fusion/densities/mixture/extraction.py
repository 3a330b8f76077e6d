"""Point estimates from a Gaussian mixture: its mean, its modes, and its components as targets."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.mixture.mixture import Factored, Mixture, moments
from track_fusion.linalg import Array, matvec, transpose

#: A mode is found when the last step, in standard deviations of the narrowest component, is this short.
SHORT = 1e-9
MAX_CLIMB = 500


def expected_a_posteriori(mixture: Mixture) -> Array:
    """Mean of each mixture, (..., n): Li 2022 (2), (20)."""
    return moments(mixture)[0]


def heaviest_mode(mixture: Mixture) -> Array:
    """Mean of the component of largest weight, (..., n): the simplified MAP estimate, Li 2022 (27)."""
    heaviest = mixture.weight.argmax(-1)[..., None, None]
    return np.asarray(np.take_along_axis(mixture.mean, heaviest, -2)[..., 0, :])


def global_mode(mixture: Mixture) -> Array:
    """Highest point of each mixture's density, (..., n): the MAP estimate, Li 2022 (28).

    Climbs from the mean of every component by the fixed point of the gradient, x = (sum r P^-1)^-1 sum r P^-1 m
    with the responsibilities r at x, which never falls, and finishes by Newton's method. All modes of a
    mixture lie near component means in few dimensions; a mode that no climb reaches is missed.
    """
    n = mixture.mean.shape[-1]
    lead, count = mixture.mean.shape[:-2], mixture.count
    factored = Factored.of(mixture)
    info = transpose(factored.white) @ factored.white
    pull = matvec(info, mixture.mean)
    x = np.array(mixture.mean, float)
    for _ in range(MAX_CLIMB):
        joint = factored.joint(x)
        share = transpose(np.exp(joint - joint.max(-2, keepdims=True)))
        share /= share.sum(-1, keepdims=True)
        total = (share @ info.reshape(*lead, count, n * n)).reshape(*lead, count, n, n)
        new = np.linalg.solve(total, (share @ pull)[..., None])[..., 0]
        step = matvec(factored.white, new - x)
        x = new
        if np.abs(step).max(initial=0.0) < SHORT:
            break
    x = _newton(factored, x)
    best = factored.log_pdf(x).argmax(-1)
    return np.asarray(np.take_along_axis(x, best[..., None, None], -2)[..., 0, :])


def _newton(factored: Factored, x: Array) -> Array:
    """Polish maxima (..., S, n) by Newton's method, keeping a step only where it does not fall."""
    for _ in range(5):
        value, gradient, hessian = factored.derivatives(x)
        peaked = np.linalg.eigvalsh(hessian)[..., -1] < 0.0
        safe = np.where(peaked[..., None, None], hessian, -np.eye(x.shape[-1]))
        new = x - np.linalg.solve(safe, gradient[..., None])[..., 0]
        better = peaked & (factored.log_pdf(new) >= value)
        x = np.where(better[..., None], new, x)
    return x


def above_threshold(mixture: Mixture, threshold: float) -> NDArray[np.bool_]:
    """Tell which components (..., C) of a PHD are targets by the threshold rule: weight > threshold, Li 2019."""
    return np.asarray(mixture.weight > threshold)


def by_rank(mixture: Mixture) -> NDArray[np.bool_]:
    """Tell which components (..., C) of a PHD are targets by the rank rule, Li 2019.

    Of a mixture whose weights sum to about N targets, the N heaviest components, N rounded.
    """
    number = np.rint(mixture.weight.sum(-1))
    rank = np.argsort(np.argsort(-mixture.weight, axis=-1, kind="stable"), axis=-1)
    return np.asarray(rank < number[..., None])
