"""Fusion with known cross-covariances against the joint Gaussian, and of filters whose errors it describes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from oracles.kalman import predict, update
from rules.examples import covariances, joint_covariances, rotated

from track_fusion.linalg import Array
from track_fusion.rules import FusedTracks, SourceTracks
from track_fusion.rules.cross_covariance import RULE, CrossCovarianceParams


def fuse(mean: Array, cov: Array, cross: Array | None = None, **params: Any) -> FusedTracks:
    extras = {} if cross is None else {"cross_cov": cross}
    return RULE(SourceTracks(mean, cov, extras=extras), CrossCovarianceParams(**params))


def drawn(rng: np.random.Generator, batch: int, count: int, n: int = 4) -> tuple[Array, Array, Array, Array]:
    """Means, covariances, cross-covariances and joint covariances of correlated tracks."""
    cov = covariances(rng, batch, count, n=n)
    joint = np.stack([joint_covariances(rng, c, 30)[-1] for c in cov])
    joint += 0.05 * np.trace(joint, axis1=1, axis2=2)[:, None, None] * np.eye(count * n)
    blocks = joint.reshape(batch, count, n, count, n).swapaxes(2, 3)
    own = blocks[:, np.arange(count), np.arange(count)]
    return rng.normal(size=(batch, count, n)), own, blocks.copy(), joint


def test_two_tracks_after_bar_shalom_and_campo() -> None:
    """x1 + (P1 - P12) (P1 + P2 - P12 - P21)^-1 (x2 - x1), the textbook formula."""
    rng = np.random.default_rng(1)
    mean, cov, cross, _ = drawn(rng, 40, 2)
    fused = fuse(mean, cov, cross, method="given")
    p12, p21 = cross[:, 0, 1], np.swapaxes(cross[:, 0, 1], -1, -2)
    gain = (cov[:, 0] - p12) @ np.linalg.inv(cov[:, 0] + cov[:, 1] - p12 - p21)
    np.testing.assert_allclose(
        fused.mean, mean[:, 0] + np.einsum("bij,bj->bi", gain, mean[:, 1] - mean[:, 0]), atol=1e-9
    )
    np.testing.assert_allclose(fused.cov, cov[:, 0] - gain @ (cov[:, 0] - p21), atol=1e-9)


@pytest.mark.parametrize("count", [2, 3, 5])
def test_generalised_least_squares(count: int) -> None:
    """The best linear unbiased estimate from the joint covariance, by its normal equations."""
    rng = np.random.default_rng(2)
    mean, cov, cross, joint = drawn(rng, 30, count)
    fused = fuse(mean, cov, cross, method="given")
    design = np.tile(np.eye(4), (count, 1))
    info = np.linalg.inv(joint)
    wanted = np.linalg.inv(design.T @ info @ design)
    np.testing.assert_allclose(fused.cov, wanted, rtol=1e-8, atol=1e-9)
    stacked = mean.reshape(30, -1)
    np.testing.assert_allclose(fused.mean, np.einsum("bij,bj->bi", wanted @ design.T @ info, stacked), atol=1e-8)


def test_without_correlation_it_is_naive_fusion() -> None:
    rng = np.random.default_rng(3)
    mean, cov = rng.normal(size=(9, 3, 4)), covariances(rng, 9, 3)
    naive = np.linalg.inv(np.linalg.inv(cov).sum(1))
    for fused in (fuse(mean, cov, correlation=0.0), fuse(mean, cov, np.zeros((9, 3, 3, 4, 4)), method="given")):
        np.testing.assert_allclose(fused.cov, naive, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("count", [2, 3])
def test_copies_of_one_track_are_that_track(count: int) -> None:
    """The joint covariance is singular: the tracks are surely equal."""
    rng = np.random.default_rng(4)
    cov = np.broadcast_to(covariances(rng, 1)[0], (count, 4, 4))
    mean = np.broadcast_to(rng.normal(size=4), (count, 4))
    fused = fuse(mean, cov, np.broadcast_to(cov[0], (count, count, 4, 4)), method="given")
    np.testing.assert_allclose(fused.mean, mean[0], atol=1e-9)
    np.testing.assert_allclose(fused.cov, cov[0], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("condition", [1e7, 1e13])
def test_complementary_vague_axes(condition: float) -> None:
    """Each track vague where the other is sharp, uncorrelated: about as sharp as the sharper one everywhere."""
    axes = np.array([[1.0, 1.0, condition, condition], [condition, condition, 1.0, 1.0]])
    cov = np.stack([rotated(np.random.default_rng(5), d) for d in axes])
    fused = fuse(np.zeros((2, 4)), cov, np.zeros((2, 2, 4, 4)), method="given")
    values = np.linalg.eigvalsh(fused.cov)
    tolerance = 1e-9 + 100 * np.finfo(float).eps * condition
    np.testing.assert_allclose(values, 1.0 / (1.0 + 1.0 / condition), rtol=tolerance)


# Correlation coefficient ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("correlation", [0.2, 0.5, 0.9])
def test_the_coefficient_of_two_scalars(correlation: float) -> None:
    fused = fuse(np.array([[1.0], [3.0]]), np.array([[[4.0]], [[9.0]]]), correlation=correlation)
    cross = correlation * 6.0
    spread = 13.0 - 2.0 * cross
    assert fused.cov[0, 0] == pytest.approx((36.0 - cross**2) / spread)
    assert fused.mean[0] == pytest.approx(((9.0 - cross) * 1.0 + (4.0 - cross) * 3.0) / spread)


def test_the_coefficient_of_a_pair_multiplies_the_geometric_mean() -> None:
    """P12 = rho P1 # P2, P1 # P2 = P1^1/2 (P1^-1/2 P2 P1^-1/2)^1/2 P1^1/2."""
    rng = np.random.default_rng(6)
    mean, cov = rng.normal(size=(12, 2, 4)), covariances(rng, 12, 2)

    def root(matrix: Array) -> Array:
        values, vectors = np.linalg.eigh(matrix)
        return (vectors * np.sqrt(values)[:, None, :]) @ np.swapaxes(vectors, -1, -2)

    half = root(cov[:, 0])
    inverse = np.linalg.inv(half)
    middle = half @ root(inverse @ cov[:, 1] @ inverse) @ half
    cross = 0.6 * np.stack([np.stack([middle] * 2, 1)] * 2, 1)
    given, assumed = fuse(mean, cov, cross, method="given"), fuse(mean, cov, correlation=0.6)
    np.testing.assert_allclose(assumed.cov, given.cov, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(assumed.mean, given.mean, atol=1e-8)


@pytest.mark.parametrize("count", [2, 3, 6])
def test_more_correlation_of_equal_tracks_is_worth_less(count: int) -> None:
    """P (1 + (K - 1) rho) / K."""
    rng = np.random.default_rng(7)
    cov = np.broadcast_to(covariances(rng, 1)[0], (count, 4, 4))
    for rho in (0.0, 0.4, 0.99):
        fused = fuse(np.zeros((count, 4)), cov, correlation=rho)
        np.testing.assert_allclose(fused.cov, cov[0] * (1.0 + (count - 1) * rho) / count, rtol=1e-8, atol=1e-9)


# Errors ---------------------------------------------------------------------------------------------------------------


def test_malformed_cross_covariances() -> None:
    mean, cov = np.zeros((2, 2)), np.stack([np.eye(2), 4.0 * np.eye(2)])
    with pytest.raises(
        ValueError, match=r"The 'cross_cov' of source tracks must have shape \(2, 2, 2, 2\). Got \(2, 2\)."
    ):
        fuse(mean, cov, np.eye(2), method="given")
    with pytest.raises(
        ValueError, match="The 'cross_cov' of source tracks must not be larger than their covariances admit."
    ):
        fuse(mean, cov, np.full((2, 2, 2, 2), 2.1 * np.eye(2)), method="given")
    with pytest.raises(ValueError, match="The 'cross_cov' of source tracks must be finite."):
        fuse(mean, cov, np.full((2, 2, 2, 2), np.nan), method="given")
    with pytest.raises(ValueError, match=r"The rule 'cross_covariance' needs 'cross_cov' beside the tracks. Got none."):
        fuse(mean, cov, method="given")


# Kalman filters of one target -----------------------------------------------------------------------------------------


def _scenario() -> tuple[Array, Array, list[Array], list[Array]]:
    transition = np.array([[1.0, 1.0], [0.0, 1.0]])
    noise = 0.3 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    return transition, noise, [np.array([[1.0, 0.0]]), np.array([[1.0, 0.2], [0.0, 1.0]]), np.array([[0.0, 1.0]])], [
        np.array([[1.0]]), np.diag([2.0, 0.5]), np.array([[0.3]])
    ]  # fmt: skip


def _joint_errors(count: int, steps: int, start: Array) -> Array:
    """Joint covariance, blocks (K, K, n, n), of the errors of filters: they are one linear system, propagated whole."""
    transition, noise, matrices, spreads = _scenario()
    joint, n = np.kron(np.ones((count, count)), start), len(start)
    for _ in range(steps):
        move = np.kron(np.eye(count), transition)
        joint = move @ joint @ move.T + np.kron(np.ones((count, count)), noise)
        lift, block = np.zeros_like(joint), np.zeros_like(joint)
        for k, (matrix, spread) in enumerate(zip(matrices[:count], spreads, strict=False)):
            at = slice(k * n, (k + 1) * n)
            gain = joint[at, at] @ matrix.T @ np.linalg.inv(matrix @ joint[at, at] @ matrix.T + spread)
            lift[at, at], block[at, at] = np.eye(n) - gain @ matrix, gain @ spread @ gain.T
        joint = lift @ joint @ lift.T + block
    return joint.reshape(count, n, count, n).swapaxes(1, 2)


def test_tracks_of_one_target_with_the_covariance_of_all_their_errors() -> None:
    transition, noise, matrices, spreads = _scenario()
    start = np.diag([4.0, 2.0])
    count, n = len(matrices), 2
    cross, covs = _joint_errors(count, 12, start), [start] * count
    for _ in range(12):
        for k, (matrix, spread) in enumerate(zip(matrices, spreads, strict=True)):
            _, cov = predict(np.zeros(n), covs[k], transition, noise)
            covs[k] = update(np.zeros(n), cov, np.zeros(len(matrix)), matrix, spread)[1]
    for i in range(count):
        np.testing.assert_allclose(cross[i, i], covs[i], atol=1e-12)
    fused = fuse(np.zeros((count, n)), np.stack(covs), cross, method="given")
    assert np.linalg.eigvalsh(np.stack(covs) - fused.cov).min() > 0  # better than each
    naive = np.linalg.inv(sum(np.linalg.inv(c) for c in covs))
    assert np.linalg.eigvalsh(fused.cov - naive).min() > 1e-3  # and honest: naive fusion claims less


def test_fusion_with_the_cross_covariances_is_consistent_in_simulation() -> None:
    """NEES of the fused track is chi-square; that of naive fusion is not."""
    transition, noise, matrices, spreads = _scenario()
    rng = np.random.default_rng(8)
    runs, start = 4000, np.diag([4.0, 2.0])
    state = rng.normal(size=(runs, 2)) * np.sqrt(np.diag(start))
    means, covs = [np.zeros((runs, 2))] * 2, [start] * 2
    for _ in range(8):
        state = state @ transition.T + rng.multivariate_normal(np.zeros(2), noise, runs)
        for k in range(2):
            z = state @ matrices[k].T + rng.multivariate_normal(np.zeros(len(spreads[k])), spreads[k], runs)
            mean, cov = predict(means[k], covs[k], transition, noise)
            means[k], covs[k], _ = update(mean, cov, z, matrices[k], spreads[k])
    tracks = np.stack(means, 1), np.broadcast_to(np.stack(covs), (runs, 2, 2, 2))
    fused = fuse(*tracks, np.broadcast_to(_joint_errors(2, 8, start), (runs, 2, 2, 2, 2)), method="given")
    error = fused.mean - state
    nees = np.einsum("bi,bij,bj->b", error, np.linalg.inv(fused.cov), error).mean() / 2
    assert nees == pytest.approx(1.0, abs=3.3 / np.sqrt(runs))
    plain = fuse(*tracks, correlation=0.0)
    error = plain.mean - state
    assert np.einsum("bi,bij,bj->b", error, np.linalg.inv(plain.cov), error).mean() / 2 > 1.03
