"""Two covariances diagonalised at once: the definition, to 40 digits where axes are sharp and vague in turn."""

from __future__ import annotations

import numpy as np
import pytest
from oracles.exact import exact, mp
from rules.examples import covariances, rotated

from track_fusion.solvers.pair import Pair, SinglePair


def test_it_is_what_it_says() -> None:
    rng = np.random.default_rng(0)
    first, second = covariances(rng, 20), covariances(rng, 20)
    pair = Pair.of(first, second)
    np.testing.assert_allclose(pair.first + pair.second, 1.0, atol=1e-15)
    np.testing.assert_allclose(pair.rebuild(pair.first), first, atol=1e-12)
    np.testing.assert_allclose(pair.rebuild(pair.second), second, atol=1e-12)
    np.testing.assert_allclose(pair.basis @ pair.inverse, np.broadcast_to(np.eye(4), first.shape), atol=1e-12)
    x = rng.normal(size=(20, 4))
    np.testing.assert_allclose(pair.from_coordinates(pair.coordinates(x)), x, atol=1e-12)
    np.testing.assert_allclose(pair.contrast, pair.second - pair.first)


@pytest.mark.parametrize("condition", [1e2, 1e7, 1e13])
@pytest.mark.parametrize("kind", ["rotated", "complementary"])
def test_shares_against_mpmath(kind: str, condition: float) -> None:
    """The shares are the eigenvalues of (P1 + P2)^-1 P1, also where each track is vague where the other is sharp."""
    rng = np.random.default_rng(2)
    if kind == "rotated":
        cov = [rotated(rng, rng.permutation(np.geomspace(1.0, condition, 4))) for _ in range(2)]
    else:
        turn = np.linalg.qr(rng.normal(size=(4, 4)))[0]
        axes = np.array([1.0, 1.0, condition, condition])
        cov = [(turn * a) @ turn.T for a in (axes, axes[::-1])]
        cov = [0.5 * (c + c.T) for c in cov]
    pair = Pair.of(cov[0][None], cov[1][None])
    for own, got in zip(cov, (pair.first, pair.second), strict=True):
        shares = mp.eig((exact(cov[0]) + exact(cov[1])) ** -1 * exact(own), left=False, right=False)
        wanted = np.sort([float(mp.re(share)) for share in shares])
        np.testing.assert_allclose(np.sort(got[:, 0]), wanted, rtol=1e-15 * condition, atol=1e-15)


def test_one_is_as_many() -> None:
    rng = np.random.default_rng(3)
    first, second = covariances(rng, 10), covariances(rng, 10)
    many = Pair.of(first, second)
    for k in range(10):
        one = SinglePair.of(first[k], second[k])
        assert one is not None
        np.testing.assert_allclose(one.first, many.first[:, k], atol=1e-13)
        np.testing.assert_allclose(one.contrast, many.contrast[:, k], atol=1e-13)
        np.testing.assert_allclose(one.rebuild(one.second), second[k], atol=1e-12)


def test_equal_covariances_have_no_contrast() -> None:
    cov = rotated(np.random.default_rng(4), np.geomspace(1.0, 1e8, 4))
    one = SinglePair.of(cov, cov)
    assert one is not None
    assert one.contrast == [0.0] * 4
    np.testing.assert_array_equal(Pair.of(cov[None], cov[None]).contrast, 0.0)


def test_a_very_sharp_axis_is_left_to_the_batch() -> None:
    assert SinglePair.of(np.diag([1.0, 1e-12]), np.eye(2)) is None
    pair = Pair.of(np.diag([1.0, 1e-12])[None], np.eye(2)[None])
    assert pair.first.min() == pytest.approx(1e-12, rel=1e-9)


def test_an_indefinite_sum_is_an_error() -> None:
    bad = np.diag([1.0, -3.0])
    with pytest.raises(np.linalg.LinAlgError):
        Pair.of(bad[None], np.eye(2)[None])
    with pytest.raises(np.linalg.LinAlgError, match="P1 \\+ P2 of a pair of covariances is not positive definite"):
        SinglePair.of(bad, np.eye(2))
