"""Naive fusion against a product of densities on a grid, and against least squares."""

from __future__ import annotations

import numpy as np
import pytest
from rules.examples import covariances
from scipy.stats import multivariate_normal

from track_fusion.rules import SourceTracks, get_rule

RULE = get_rule("naive")


def test_moments_of_the_normalised_product_on_a_grid() -> None:
    """Li 2022 (14): the density is proportional to the product."""
    mean = np.array([[0.0, 0.5], [1.0, -0.5], [0.3, 0.2]])
    cov = covariances(np.random.default_rng(1), 3, n=2)
    axis = np.linspace(-8.0, 8.0, 401)
    points = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1)
    density = np.prod([multivariate_normal(m, p).pdf(points) for m, p in zip(mean, cov, strict=True)], 0)
    density /= density.sum()
    wanted = np.einsum("ij,ijk->k", density, points)
    spread = np.einsum("ij,ijk,ijl->kl", density, points - wanted, points - wanted)
    fused = RULE(SourceTracks(mean, cov))
    np.testing.assert_allclose(fused.mean, wanted, atol=1e-9)
    np.testing.assert_allclose(fused.cov, spread, atol=1e-9)


def test_least_squares_of_independent_tracks() -> None:
    rng = np.random.default_rng(2)
    mean, cov = rng.normal(size=(3, 4)), covariances(rng, 3)
    # Each track is a measurement of the state; whitened rows make it an ordinary least-squares problem.
    roots = [np.linalg.inv(np.linalg.cholesky(p)) for p in cov]
    rows, seen = np.concatenate(roots), np.concatenate([w @ m for w, m in zip(roots, mean, strict=True)])
    wanted = np.linalg.lstsq(rows, seen, rcond=None)[0]
    fused = RULE(SourceTracks(mean, cov))
    np.testing.assert_allclose(fused.mean, wanted, rtol=1e-10)
    upper = np.linalg.qr(rows)[1]
    np.testing.assert_allclose(fused.cov, np.linalg.inv(upper.T @ upper), rtol=1e-10)


@pytest.mark.parametrize("count", [2, 3, 7])
def test_copies_are_counted_as_news(count: int) -> None:
    cov = np.diag([4.0, 9.0])
    fused = RULE(SourceTracks(np.ones((count, 2)), np.broadcast_to(cov, (count, 2, 2))))
    np.testing.assert_allclose(fused.cov * count, cov, rtol=1e-12)


def test_errors_are_consistent_when_independent_and_overconfident_when_not() -> None:
    """Mean squared Mahalanobis length of the error over n: 1 if the claim is right (5000 draws, s.e. .014)."""
    rng = np.random.default_rng(3)
    cov = covariances(rng, 2)
    root = np.linalg.cholesky(cov)
    own, common = rng.normal(size=(5000, 2, 4)), rng.normal(size=(5000, 1, 4))
    share = 0.8

    def nees(draws: np.ndarray) -> float:
        mean = np.einsum("kij,bkj->bki", root, draws)
        fused = RULE(SourceTracks(mean, np.broadcast_to(cov, (5000, 2, 4, 4))))
        return float(np.mean(np.einsum("bi,bij,bj->b", fused.mean, np.linalg.inv(fused.cov), fused.mean)) / 4)

    assert nees(own) == pytest.approx(1.0, abs=0.05)
    assert nees(np.sqrt(share) * common + np.sqrt(1.0 - share) * own) > 1.5
