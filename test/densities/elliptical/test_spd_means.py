"""Means of positive definite matrices against pyriemann, 40-digit arithmetic and their laws."""

from __future__ import annotations

import numpy as np
import pytest
from oracles.exact import exact, mp
from rules.examples import covariances, rotated

from track_fusion.densities.elliptical.spd_means import karcher_mean, log_euclidean_mean
from track_fusion.linalg import Array


@pytest.mark.parametrize("count", [1, 2, 3, 7])
def test_means_against_pyriemann(count: int) -> None:
    # Imported here, for it is in no Linux distribution: where it is missing, all other tests are collected.
    from pyriemann.utils.mean import mean_logeuclid, mean_riemann

    matrices = covariances(np.random.default_rng(count), 12, count, n=5)
    found = karcher_mean(matrices)
    assert found.converged.all()
    flat = log_euclidean_mean(matrices)
    for i, group in enumerate(matrices):
        np.testing.assert_allclose(found.mean[i], mean_riemann(group, tol=1e-12, maxiter=500), rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(flat[i], mean_logeuclid(group), rtol=1e-10, atol=1e-10)


def test_karcher_mean_solves_its_equation() -> None:
    """Eq. (58) by eigenvectors of matrices that are not symmetric."""
    matrices = covariances(np.random.default_rng(1), 4, 5, n=3)
    for group, mean in zip(matrices, karcher_mean(matrices).mean, strict=True):
        values, vectors = np.linalg.eig(np.linalg.inv(group) @ mean)
        total = ((vectors * np.log(values)[:, None]) @ np.linalg.inv(vectors)).sum(0)
        assert np.abs(total).max() < 1e-10


def test_karcher_mean_moves_with_the_axes_and_inverts() -> None:
    rng = np.random.default_rng(2)
    matrices = covariances(rng, 6, 4, n=4)
    change = rng.normal(size=(4, 4)) * np.array([1.0, 1e4, 1e-4, 1.0])[:, None]
    here = karcher_mean(matrices).mean
    moved = change @ matrices @ change.T
    there = karcher_mean(0.5 * (moved + np.swapaxes(moved, -1, -2))).mean
    sigma = np.sqrt(np.diagonal(there, axis1=-2, axis2=-1))
    assert (np.abs(change @ here @ change.T - there) / (sigma[:, :, None] * sigma[:, None])).max() < 1e-10
    back = np.linalg.inv(karcher_mean(np.linalg.inv(matrices)).mean)
    np.testing.assert_allclose(back, here, rtol=1e-8)
    # det of either mean is the geometric mean of the determinants
    for mean in (here, log_euclidean_mean(matrices)):
        np.testing.assert_allclose(np.linalg.det(mean), np.linalg.det(matrices).prod(-1) ** 0.25, rtol=1e-10)


def _gradient(mean: Array, group: Array) -> float:
    """Norm of the mean of Log(S^-1/2 P_k S^-1/2), in 40 digits."""
    lower = mp.cholesky(exact(mean)) ** -1
    total = mp.zeros(len(mean))
    for p in group:
        values, vectors = mp.eigsy(lower * exact(p) * lower.T)
        total += vectors * mp.diag([mp.log(v) for v in values]) * vectors.T / len(group)
    return float(mp.mnorm(total, "f"))


@pytest.mark.parametrize("condition", [1e6, 1e10, 1e13])
@pytest.mark.parametrize("count", [2, 3, 5])
def test_hard_matrices_in_40_digits(condition: float, count: int) -> None:
    """Rotated, each sharp along one axis where the others are vague; the error of the mean is at most the gradient."""
    rng = np.random.default_rng(5)
    basis = np.linalg.qr(rng.normal(size=(count, count)))[0]
    complementary = [(basis * np.where(np.arange(count) == k, 1.0 / condition, 1.0)) @ basis.T for k in range(count)]
    turned = [rotated(rng, np.geomspace(1.0 / condition, 1.0, 3)) for _ in range(count)]
    for group in (np.stack(complementary), np.stack(turned)):
        group = 0.5 * (group + np.swapaxes(group, -1, -2))
        found = karcher_mean(group[None])
        assert found.converged.all()
        # The matrices themselves, rounded to doubles, are known along a sharp axis to eps times the condition.
        assert _gradient(found.mean[0], group) < 1e-8 + 1e-16 * condition * 30


def test_batch_in_pieces_and_empty() -> None:
    matrices = covariances(np.random.default_rng(6), 600, 3, n=2)
    whole = karcher_mean(matrices).mean
    np.testing.assert_allclose(whole[577], karcher_mean(matrices[577:578]).mean[0], rtol=1e-12)
    assert karcher_mean(matrices[:0]).mean.shape == (0, 2, 2)
    same = np.broadcast_to(matrices[:1, :1], (1, 2, 2, 2))
    np.testing.assert_array_equal(karcher_mean(same).mean[0], matrices[0, 0])
