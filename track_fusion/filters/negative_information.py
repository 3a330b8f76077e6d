"""Gaussian-mixture update by what a detector says, or does not say: "no detection" is information too."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from track_fusion.densities.log_domain import log_of, log_sum_exp, normalised
from track_fusion.densities.mixture.mixture import LOG_2PI, Mixture
from track_fusion.filters.base import Evidence, Gaussian
from track_fusion.filters.extended import Extended
from track_fusion.linalg import Array, cholesky, inverse, matvec, outer, solve, symmetrise, transpose
from track_fusion.models.base import Transition
from track_fusion.models.detection import SoftmaxDetector

#: Newton's iteration for the mode of a component: at most so many steps, each halved at most so often.
NEWTON_STEPS, HALVINGS = 50, 30
#: The mode is reached when the next step is shorter than this, in standard deviations.
MODE_TOLERANCE = 1e-6
#: Laplace's covariance is inflated so much: a softly cut Gaussian has a longer tail than its mode suggests.
INFLATION = 2.0


@dataclasses.dataclass(frozen=True)
class SampledEvidence(Evidence):
    """What an update learned: of what the detector said; effective share (..., M C) of each component's samples."""

    effective_share: Array


@dataclasses.dataclass(frozen=True)
class NegativeInformation:
    """A filter of mixtures that are cut by what a detector says.

    Attributes
    ----------
    samples : int          points for the moments of each new component
    negligible : float     a component over which the event's probability varies (standard deviation over mean) by no
                           more than this keeps its shape and is weighed only: far cameras split nothing
    seed : int             of the points' common shift

    Notes         Each component times each class is log-concave; it becomes the Gaussian of its own moments, found by
                  importance sampling with quasi-random points, half of them from the component, half about the
                  product's mode.
    References    Ahmed 5.3; N. Ahmed, E. Sample, M. Campbell, Bayesian multicategorical soft data fusion, 2013,
                  whose variational bound the mode replaces here.
    """

    samples: int = 512
    negligible: float = 0.0
    seed: int = 0

    def predict(self, mixture: Mixture, transition: Transition) -> Mixture:
        """Predict x' = f(x) + w component by component, f linearised at its mean."""
        moved = Extended().predict(Gaussian(mixture.mean, mixture.cov), transition)
        return Mixture(mixture.weight, moved.mean, moved.cov)

    def update(self, mixture: Mixture, chance: Array, detector: SoftmaxDetector) -> tuple[Mixture, SampledEvidence]:
        """Condition on an event that has probability chance_c when the target is in the detector's class c.

        For a camera with class 0 inside its view and detection probability p: a detection has chances (p, 0, 0, ...),
        no detection (1 - p, 1, 1, ...).

        Parameters
        ----------
        mixture : Mixture            (..., M) components
        chance : (C,)                between 0 and 1, at least one positive
        detector : SoftmaxDetector   C classes

        Returns
        -------
        Mixture    (..., M C') components, C' classes of positive chance, weights of sum one; of a component that keeps
                   its shape all but the first have weight 0; SampledEvidence

        Raises
        ------
        ValueError    chances do not fit the classes or lie outside [0, 1], or all are zero

        Notes         The mixture grows C'-fold: reduce it afterwards. O(M C' samples n^2).
        """
        chance = _checked(chance, len(detector.bias))
        used = np.flatnonzero(chance > 0)
        points = _normal_points(mixture.mean.shape[-1], self.samples, self.seed)
        log_mass, mean, cov, share = _split(mixture, detector, chance, used, points, self.negligible)
        log_weight = log_of(mixture.weight)[..., None] + log_mass
        (*lead, count, classes), n = log_weight.shape, mean.shape[-1]
        size = count * classes
        flat = log_weight.reshape(*lead, size)
        cut = Mixture(normalised(flat), mean.reshape(*lead, size, n), cov.reshape(*lead, size, n, n))
        log_likelihood = log_sum_exp(flat) - np.log(mixture.weight.sum(-1))
        return cut, SampledEvidence(np.asarray(log_likelihood), share.reshape(*lead, size))


def _split(
    mixture: Mixture, detector: SoftmaxDetector, chance: Array, used: NDArray[np.intp], points: Array, negligible: float
) -> tuple[Array, Array, Array, Array]:
    """Log-probability (..., M, C') of the event, mean, covariance and effective share of every component by class."""
    log_event, varying = _event(mixture, detector, chance, points, negligible)
    shape = (*varying.shape, len(used))
    log_mass = np.full(shape, -np.inf)
    log_mass[..., 0] = log_event
    mean = np.repeat(mixture.mean[..., None, :], len(used), -2)
    cov = np.repeat(mixture.cov[..., None, :, :], len(used), -3)
    share = np.ones(shape)
    if varying.any():
        parts = _products(mean[varying][:, :1], cov[varying][:, :1], detector, used, points)
        log_mass[varying] = np.log(chance[used]) + parts[0]
        mean[varying], cov[varying], share[varying] = parts[1:]
    return log_mass, mean, cov, share


def _event(
    mixture: Mixture, detector: SoftmaxDetector, chance: Array, points: Array, negligible: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Log of the event's probability under each component (..., M), and whether it varies there."""
    if negligible <= 0.0:
        return np.zeros(mixture.weight.shape), np.ones(mixture.weight.shape, bool)
    x = mixture.mean[..., None, :] + points @ transpose(cholesky(mixture.cov))
    probability = np.exp(detector.log_probability(x)) @ chance
    average = probability.mean(-1)
    varying = probability.std(-1) > negligible * average
    return np.log(np.where(varying, 1.0, average)), varying


def _checked(chance: Array, classes: int) -> Array:
    chance = np.asarray(chance, float)
    if chance.shape != (classes,) or (chance < 0).any() or (chance > 1).any() or not chance.any():
        raise ValueError(f"The 'chance' must hold {classes} numbers from 0 to 1, not all 0. Got {chance}.")
    return chance


@lru_cache(maxsize=16)
def _normal_points(size: int, count: int, seed: int) -> Array:
    """Quasi-random standard normals (S, n): a shifted lattice of the generalised golden ratio, of mean zero."""
    root = 2.0
    for _ in range(60):
        root = (1.0 + root) ** (1.0 / (size + 1))
    steps = root ** -np.arange(1, size + 1)
    shift = np.random.default_rng(seed).random(size)
    uniform = (shift + np.arange(1, count // 2 + 1)[:, None] * steps) % 1.0
    points = ndtri(np.clip(uniform, 1e-12, 1.0 - 1e-12))
    return np.concatenate([points, -points])


def _products(
    mean: Array, cov: Array, detector: SoftmaxDetector, used: NDArray[np.intp], points: Array
) -> tuple[Array, Array, Array, Array]:
    """Log-mass (..., M, C), mean, covariance and effective share of each Gaussian (..., M, 1) times each class."""
    mode, laplace = _laplace(mean, cov, detector, used)
    prior_root = np.broadcast_to(cholesky(cov), laplace.shape)
    mode_root = cholesky(INFLATION * laplace)
    x = np.concatenate([mean[..., None, :] + points @ transpose(prior_root),
                        mode[..., None, :] + points @ transpose(mode_root)], -2)  # fmt: skip
    log_prior = _log_normal(x - mean[..., None, :], prior_root)
    log_proposal = np.logaddexp(log_prior, _log_normal(x - mode[..., None, :], mode_root)) - np.log(2.0)
    every = detector.log_probability(x)
    log_class = np.stack([every[..., i, :, c] for i, c in enumerate(used)], -2)
    log_weight = log_prior + log_class - log_proposal
    top = log_weight.max(-1, keepdims=True)
    weight = np.exp(log_weight - top)
    total = weight.sum(-1, keepdims=True)
    log_mass = np.log(total / weight.shape[-1])[..., 0] + top[..., 0]
    weight = weight / total
    offset = x - mode[..., None, :]
    shift = (weight[..., None] * offset).sum(-2)
    centred = offset - shift[..., None, :]
    new_cov = symmetrise(transpose(weight[..., None] * centred) @ centred)
    share = 1.0 / ((weight**2).sum(-1) * weight.shape[-1])
    return log_mass, mode + shift, new_cov, share


def _log_normal(gap: Array, root: Array) -> Array:
    """Log of N(gap; 0, L L'), (..., S, n), (..., n, n) -> (..., S)."""
    white = gap @ transpose(np.asarray(np.linalg.inv(root), np.float64))
    half_logdet = np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(-1)
    return np.asarray(-0.5 * (white**2).sum(-1) - half_logdet[..., None] - 0.5 * gap.shape[-1] * LOG_2PI)


def _laplace(mean: Array, cov: Array, detector: SoftmaxDetector, used: NDArray[np.intp]) -> tuple[Array, Array]:
    """Mode (..., M, C, n) of each Gaussian (..., M, 1) times each class, and Laplace's covariance, by Newton."""
    info = inverse(cov)
    x = np.broadcast_to(mean, (*mean.shape[:-2], len(used), mean.shape[-1])).copy()
    own = detector.weight[used]

    def value(at: Array) -> Array:
        every = detector.log_probability(at)
        chosen = np.stack([every[..., i, c] for i, c in enumerate(used)], -1)
        gap = at - mean
        return np.asarray(chosen - 0.5 * (gap * matvec(info, gap)).sum(-1))

    now = value(x)
    for _ in range(NEWTON_STEPS):
        gradient, curvature = _derivatives(x, mean, info, detector, own)
        step = solve(curvature, gradient[..., None])[..., 0]
        if (np.abs((step * gradient).sum(-1)) < MODE_TOLERANCE**2).all():
            break
        x, now = _climb(x, now, step, value)
    return x, inverse(_derivatives(x, mean, info, detector, own)[1])


def _derivatives(x: Array, mean: Array, info: Array, detector: SoftmaxDetector, own: Array) -> tuple[Array, Array]:
    """Gradient (..., n) and negative Hessian (..., n, n), positive definite, of the log-product."""
    probability = np.exp(detector.log_probability(x))
    centre = probability @ detector.weight
    spread = transpose(probability[..., :, None] * detector.weight) @ detector.weight - outer(centre)
    return own - centre - matvec(info, x - mean), symmetrise(info + spread)


def _climb(x: Array, now: Array, step: Array, value: Callable[[Array], Array]) -> tuple[Array, Array]:
    """Take each step, halved until it does not descend."""
    length = np.ones(now.shape)
    for _ in range(HALVINGS):
        new = value(x + length[..., None] * step)
        worse = new < now
        if not worse.any():
            break
        length = np.where(worse, 0.5 * length, length)
    length = np.where(worse, 0.0, length)
    moved = x + length[..., None] * step
    return moved, np.where(worse, now, new)
