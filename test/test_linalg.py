"""Leaves of linear algebra on stacks of matrices, against NumPy one matrix at a time."""

from __future__ import annotations

import numpy as np
import pytest

from track_fusion import linalg
from track_fusion.linalg import Array


def stack(*shape: int, n: int = 3) -> Array:
    root = np.random.default_rng(0).normal(size=(*shape, n, n + 2))
    return root @ np.swapaxes(root, -1, -2)


@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (0,)])
def test_every_matrix_as_if_alone(shape: tuple[int, ...]) -> None:
    cov, x = stack(*shape), np.random.default_rng(1).normal(size=(*shape, 3))
    one, white = np.broadcast_to(np.eye(3), cov.shape), linalg.whitener(cov)
    np.testing.assert_allclose(linalg.cholesky(cov) @ np.swapaxes(linalg.cholesky(cov), -1, -2), cov, atol=1e-12)
    np.testing.assert_allclose(white @ cov @ np.swapaxes(white, -1, -2), one, atol=1e-12)
    np.testing.assert_allclose(np.triu(white, 1), 0.0, atol=1e-14)
    np.testing.assert_allclose(linalg.inverse(cov) @ cov, one, atol=1e-10)
    np.testing.assert_array_equal(linalg.inverse(cov), np.swapaxes(linalg.inverse(cov), -1, -2))
    np.testing.assert_allclose(linalg.solve(cov, linalg.outer(x)), np.linalg.inv(cov) @ linalg.outer(x), atol=1e-9)
    np.testing.assert_allclose(linalg.logdet(cov), np.linalg.slogdet(cov)[1], atol=1e-12)
    square = linalg.mahalanobis_squared(x, cov)
    assert square.shape == shape
    for i in np.ndindex(shape):
        assert square[i] == pytest.approx(x[i] @ np.linalg.inv(cov[i]) @ x[i], rel=1e-9)
        np.testing.assert_allclose(linalg.matvec(cov, x)[i], cov[i] @ x[i], rtol=1e-12)


def test_elimination_goes_on_past_what_is_not_definite() -> None:
    cov, b = stack(4, 5), np.random.default_rng(2).normal(size=(4, 5, 3))
    cov[1, 2], cov[3, 0], cov[0, 4] = np.diag([1.0, -1.0, 2.0]), np.zeros((3, 3)), -np.eye(3)
    before = cov.copy(), b.copy()
    positive, logdet, square = linalg.eliminate(cov, b)
    assert np.argwhere(~positive).tolist() == [[0, 4], [1, 2], [3, 0]]
    np.testing.assert_allclose(logdet[positive], np.linalg.slogdet(cov[positive])[1], atol=1e-12)
    np.testing.assert_allclose(square[positive], linalg.mahalanobis_squared(b[positive], cov[positive]), rtol=1e-9)
    np.testing.assert_array_equal(cov, before[0])
    np.testing.assert_array_equal(b, before[1])


@pytest.mark.parametrize("bad", [[], [0], [6], [0, 1, 2, 3, 4, 5, 6], [2, 5]])
def test_indefinite_matrices_are_found_among_definite_ones(bad: list[int]) -> None:
    cov = stack(7)
    cov[bad] = np.diag([1.0, 1.0, -1e-9])
    wanted = [i not in bad for i in range(7)]
    assert linalg.is_positive_definite(cov).tolist() == wanted
    assert linalg.is_positive_definite(cov.reshape(7, 1, 3, 3)).shape == (7, 1)
    assert bool(linalg.is_positive_definite(cov[0])) == wanted[0]


def test_definite_by_rounding_alone_is_not_well_conditioned() -> None:
    """1 - 1e-13 of correlation leaves 2e-13 of a variance, of which a millionth of a millionth is taken as a trial."""
    cov = np.array([[[1.0, r], [r, 1.0]] for r in (0.0, 1 - 1e-6, 1 - 1e-13)])
    assert linalg.is_positive_definite(cov).tolist() == [True, True, True]
    assert linalg.is_well_conditioned(cov).tolist() == [True, True, False]
    scale = linalg.outer(np.array([1e-9, 1e9]))  # units do not matter
    assert linalg.is_well_conditioned(cov * scale).tolist() == [True, True, False]


def test_asymmetric_means_by_more_than_rounding() -> None:
    cov = stack(3)
    assert not linalg.asymmetric(cov)
    cov[1, 0, 2] += 1e-9
    assert not linalg.asymmetric(cov)
    cov[1, 0, 2] += 1e-3
    assert linalg.asymmetric(cov)
    np.testing.assert_array_equal(linalg.symmetrise(cov), np.swapaxes(linalg.symmetrise(cov), -1, -2))
