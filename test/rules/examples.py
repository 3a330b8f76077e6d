"""Counter-examples of the rules that promise less, as their docstrings state them, and covariances to try rules on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest

from track_fusion.linalg import Array
from track_fusion.params import from_dict
from track_fusion.rules import RULES, Mixture, SourceTracks
from track_fusion.rules.trials import covariances, joint_covariances

__all__ = ["COUNTER_EXAMPLES", "covariances", "joint_covariances", "rotated", "scalar_nees"]


def _naive_copies() -> tuple[float, float]:
    """Four copies of N(0, P): the docstring of the rule says that they claim P / 4 with an error of P."""
    cov = np.array([[4.0, 1.0], [1.0, 2.0]])
    fused = RULES["naive"](SourceTracks(np.full((4, 2), 3.0), np.broadcast_to(cov, (4, 2, 2))))
    error = cov  # the mean of copies is the copy
    np.testing.assert_allclose(fused.mean, 3.0)
    return float(np.trace(error) / np.trace(fused.cov)), 4.0


def _weights_that_follow_the_errors() -> tuple[float, float]:
    """Three scalar tracks whose errors are 3, 2, 2 in four cases of five, and else 4, 6, 4."""
    error, chance = np.array([[3.0, 2.0, 2.0], [4.0, 6.0, 4.0]])[..., None], np.array([0.8, 0.2])
    variance = np.einsum("c,cki->k", chance, error**2)
    np.testing.assert_allclose(variance, [10.4, 10.4, 6.4])
    fused = RULES["arithmetic_average"](SourceTracks(error, np.tile(variance[:, None, None], (2, 1, 1, 1))))
    return float(chance @ fused.mean[:, 0] ** 2 / (chance @ fused.cov[:, 0, 0])), 1.115


def _another_correlation() -> tuple[float, float]:
    """Two tracks of variance 1 whose errors have the correlation .9, said to have the default's .4."""
    fused = RULES["cross_covariance"](SourceTracks(np.array([[1.0], [0.0]]), np.ones((2, 1, 1))))
    np.testing.assert_allclose(fused.mean, 0.5)  # half of each
    return (0.25 + 0.25 + 2.0 * 0.25 * 0.9) / float(fused.cov[0, 0]), 0.95 / 0.7


def _overlapping_copies() -> tuple[float, float]:
    """Two copies of a track with components N(+-sqrt 2, 1), fused by powers of components."""
    part = Mixture(np.full((2, 2), 0.5), np.full((2, 2, 1), 2**0.5) * [[1.0], [-1.0]], np.ones((2, 2, 1, 1)))
    fused = RULES["mixture_geometric"](SourceTracks(np.zeros((2, 1)), np.full((2, 1, 1), 3.0), mixture=part))
    return 3.0 / float(fused.cov[0, 0]), 3.0 / 2.462


def _copies_that_share_more() -> tuple[float, float]:
    """Two copies of N(0, P), said to share N(0, 2 P) only."""
    cov = np.array([[4.0, 1.0], [1.0, 2.0]])
    common = Mixture(np.ones(1), np.zeros((1, 2)), 2.0 * cov[None])
    tracks = SourceTracks(np.zeros((2, 2)), np.stack([cov, cov]), extras={"common": common})
    return float(np.trace(cov) / np.trace(RULES["mixture_exact"](tracks).cov)), 1.5


def _double_counting() -> tuple[float, float]:
    """Two copies of N(0, P) by mixture_wep's method naive_bayes."""
    cov, rule = np.array([[4.0, 1.0], [1.0, 2.0]]), RULES["mixture_wep"]
    tracks = SourceTracks(np.zeros((2, 2)), np.stack([cov, cov]))
    fused = rule(tracks, from_dict(rule.params, {"method": "naive_bayes"}))
    return float(np.trace(cov) / np.trace(fused.cov)), 2.0


def _few_samples() -> tuple[float, float]:
    """Two tracks of variance 1 and of equal errors, fused from fifty samples."""
    rule = RULES["geometric_mean_sampling"]
    tracks = SourceTracks(np.array([[0.0], [1e-9]]), np.ones((2, 1, 1)), extras={"seed": 1})
    return 1.0 / float(rule(tracks, from_dict(rule.params, {"samples": 50})).cov[0, 0]), 1.0 / 0.765


def _diagonal_pair(key: str, ratio: float, values: Mapping[str, Any], cross: Array) -> float:
    """Fuse diag(1, r) and diag(r, 1); return the error variance over the claim, along (1, 1), at this correlation."""
    rule, cov = RULES[key], np.stack([np.diag([1.0, ratio]), np.diag([ratio, 1.0])])
    joint = np.block([[cov[0], cross], [cross.T, cov[1]]])
    assert np.linalg.eigvalsh(joint).min() > -1e-12  # the cross-covariance is admissible
    probes = np.concatenate([np.eye(4), np.zeros((1, 4))]).reshape(5, 2, 2)
    fused = rule(SourceTracks(probes, np.broadcast_to(cov, (5, 2, 2, 2))), from_dict(rule.params, values))
    gain, along = fused.mean[:4].T, np.ones(2)
    return float(along @ gain @ joint @ gain.T @ along / (along @ fused.cov[4] @ along))


def _inverse_intersection() -> tuple[float, float]:
    return _diagonal_pair("inverse_covariance_intersection", 4.0, {}, np.array([[0.0, 1.0], [4.0, 0.0]])), 1.53


def _ellipsoidal_intersection() -> tuple[float, float]:
    """The errors of the two sharp axes are equal: cov(e1, e2)[0, 1] = 1."""
    return _diagonal_pair("ellipsoidal_intersection", 4.0, {}, np.array([[0.0, 1.0], [0.0, 0.0]])), 2.0


def _quadrature(count: int = 48) -> tuple[Array, Array]:
    """Nodes (count^2, 2) and weights of expectations over two independent standard normal variables."""
    x, w = np.polynomial.hermite_e.hermegauss(count)
    return np.stack(np.meshgrid(x, x, indexing="ij"), -1).reshape(-1, 2), np.outer(w, w).ravel() / w.sum() ** 2


def _fast_intersection() -> tuple[float, float]:
    """P1 = diag(1, 12), P2 = diag(12, 1), e2 = P2^1/2 R P1^-1/2 e1 with R a turn by 40 degrees."""
    z, weight = _quadrature()
    turn = np.deg2rad(40.0)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    cov = np.stack([np.diag([1.0, 12.0]), np.diag([12.0, 1.0])])
    errors = np.stack([z @ np.sqrt(cov[0]), z @ rotation.T @ np.sqrt(cov[1])], 1)
    fused = RULES["fast_covariance_intersection"](SourceTracks(errors, np.broadcast_to(cov, (len(z), 2, 2, 2))))
    error = np.einsum("b,bi,bj->ij", weight, fused.mean, fused.mean)
    claim = np.einsum("b,bij->ij", weight, fused.cov)
    return float(np.linalg.eigvals(np.linalg.solve(claim, error)).real.max()), 1.043


def scalar_nees(variances: tuple[float, float], correlation: float, values: Mapping[str, Any]) -> float:
    """Mean of the squared error over the claim of the harmonic mean of two scalar tracks, by summation over a grid."""
    axis = np.linspace(-8.0, 8.0, 401)
    z = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    weight = np.exp(-0.5 * (z**2).sum(1))
    first = z[:, 0]
    second = correlation * z[:, 0] + np.sqrt(1.0 - correlation**2) * z[:, 1]
    mean = np.stack([first, second], 1) * np.sqrt(variances)
    rule, cov = RULES["harmonic_mean"], np.broadcast_to(np.array(variances)[:, None, None], (len(z), 2, 1, 1))
    fused = rule(SourceTracks(mean[..., None], cov), from_dict(rule.params, values))
    return float((weight * fused.mean[:, 0] ** 2 / fused.cov[:, 0, 0]).sum() / weight.sum())


def _shared_error(key: str, stated: float) -> Callable[[], tuple[float, float]]:
    """Three scalar tracks of variance 1: an error of 10 that a random pair shares in 1.5 % of all cases."""

    def ratio() -> tuple[float, float]:
        error, chance = np.array([10.0, 0.0]), np.array([0.015, 0.985])
        mean = error[:, None, None] * np.array([1.0, 1.0, 0.0])[:, None]
        assert chance @ (error**2 * 2.0 / 3.0) == pytest.approx(1.0)  # the variance of each track, over all pairs
        fused = RULES[key](SourceTracks(mean, np.ones((2, 3, 1, 1))))
        return float(chance @ fused.mean[:, 0] ** 2 / (chance @ fused.cov[:, 0, 0])), stated

    return ratio


def rotated(rng: np.random.Generator, eigenvalues: Array) -> Array:
    """Draw a covariance with these eigenvalues in a random orientation."""
    basis = np.linalg.qr(rng.normal(size=(len(eigenvalues),) * 2))[0]
    cov = (basis * eigenvalues) @ basis.T
    return 0.5 * (cov + cov.T)


#: The true error variance over the claimed one, measured and as stated, for every rule of guarantee none or structural.
COUNTER_EXAMPLES: dict[str, Callable[[], tuple[float, float]]] = {
    "naive": _naive_copies,
    "arithmetic_average": _weights_that_follow_the_errors,
    "cross_covariance": _another_correlation,
    "fast_covariance_intersection": _fast_intersection,
    "inverse_covariance_intersection": _inverse_intersection,
    "ellipsoidal_intersection": _ellipsoidal_intersection,
    "mixture_geometric": _overlapping_copies,
    "mixture_hybrid": _overlapping_copies,
    "mixture_wep": _double_counting,
    "geometric_mean_sampling": _few_samples,
    "mixture_exact": _copies_that_share_more,
    "harmonic_mean": lambda: (scalar_nees((1.0, 10.0), 0.9, {}), 1.09),
    "mhdp_explicit": _shared_error("mhdp_explicit", 1.36),
    "mhdp_iterative": _shared_error("mhdp_iterative", 1.36),
    "quasi_minimal_manhattan": _shared_error("quasi_minimal_manhattan", 1.26),
    "geodesic_projection": _shared_error("geodesic_projection", 1.42),
}
