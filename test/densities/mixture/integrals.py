"""Gaussians over mixtures whose smallest information difference is known, for tests of what has an integral."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from track_fusion.densities.mixture.algebra import LogMixture
from track_fusion.densities.mixture.integrability import EFFECTIVE, Verdicts, effective_share, integrability
from track_fusion.densities.mixture.mixture import Factored, Mixture
from track_fusion.densities.mixture.quotient import Quotient, exact_bound
from track_fusion.linalg import Array

PROBLEMS = 100  # of two axes, and as many of three


def quotient_of(cov: Array, common: Mixture) -> Quotient:
    """One mixand N(0, cov) over a mixture."""
    numerator = LogMixture(np.zeros(1), np.zeros((1, len(cov))), cov[None])
    return Quotient(numerator, ((Factored.of(common), np.ones(())),))


def verdict(cov: Array, common: Mixture) -> Verdicts:
    quotient = quotient_of(cov, common)
    return integrability(quotient, common, exact_bound(quotient, common).sure)


def least_ratio(rng: np.random.Generator, info: Array) -> float:
    """Largest over v of the least of v' I_t v, |v| = 1, for informations (T, n, n) of two or three axes."""
    if info.shape[-1] == 2:
        turn = np.linspace(0.0, np.pi, 20001)
        v = np.stack([np.cos(turn), np.sin(turn)], 1)
    else:
        v = rng.normal(size=(20000, 3))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    value = np.einsum("si,tij,sj->st", v, info, v).min(1)
    best, radius = [(float(value[k]), v[k]) for k in np.argsort(-value)[:3]], 0.02
    for _ in range(60):  # closer and closer about each of the best
        for i, (least, at) in enumerate(best):
            near = at + radius * rng.normal(size=(50, len(at)))
            near /= np.linalg.norm(near, axis=1, keepdims=True)
            there = np.einsum("si,tij,sj->st", near, info, near).min(1)
            best[i] = max((least, at), (float(there.max()), near[there.argmax()]), key=lambda found: found[0])
        radius *= 0.8
    return max(least for least, _ in best)


class Problem(NamedTuple):
    """A Gaussian and a mixture, the smallest information difference of which is known."""

    cov: Array
    common: Mixture
    difference: float


@functools.cache
def problems(low: float, high: float) -> list[Problem]:
    """Draw problems whose smallest information difference is so much: the common information is scaled for it."""
    rng, drawn = np.random.default_rng(1), []
    for i in range(2 * PROBLEMS):
        n, count = 2 + i % 2, int(rng.integers(3, 9))
        root = rng.normal(size=(count, n, n + 1))
        if i % 4 < 2:  # as it comes
            shape = root @ np.swapaxes(root, -1, -2)
        else:  # each long or short along axes of its own
            turn = np.linalg.qr(root[..., :n])[0] * 10.0 ** rng.uniform(-0.75, 0.75, (count, 1, n))
            shape = turn @ np.swapaxes(turn, -1, -2)
        difference = rng.uniform(low, high)
        scale = (1.0 - difference) / least_ratio(rng, np.linalg.inv(shape))
        lower = np.linalg.cholesky(np.cov(rng.normal(size=(n, 3 * n))))
        cov = lower @ shape / scale @ lower.T
        weight, mean = rng.dirichlet(np.ones(count)), rng.normal(size=(count, n)) @ lower.T
        drawn.append(Problem(lower @ lower.T, Mixture(weight, mean, cov), difference))
    return drawn


def taken(problem: Problem, seed: int = 0) -> bool:
    """Tell whether more than a hundredth of the samples of an undecided mixand count."""
    quotient = quotient_of(problem.cov, problem.common)
    share = effective_share(quotient, np.ones(1, bool), np.random.default_rng(seed))
    return bool(share[0] > EFFECTIVE)
