"""Projection means of long tracks that contradict each other: many local minima, against 200 random starts."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from track_fusion.densities.elliptical.projection import nearest_mean
from track_fusion.linalg import Array

#: Weight c of a squared Mahalanobis distance.
PULL = 0.5
#: Draws of each of the sizes.
DRAWS = 20
#: Long over short axis, and distance between the means, in short axes.
SHAPES = ((30.0, 30.0), (100.0, 100.0), (1000.0, 100.0))
#: Axes, tracks, long axes of each.
SIZES = ((2, 4, 1), (2, 8, 1), (3, 6, 1), (3, 8, 2), (4, 6, 3), (4, 8, 1))


def draw(rng: np.random.Generator, size: tuple[int, int, int], ratio: float, apart: float) -> tuple[Array, Array]:
    """Draw tracks, (DRAWS, K, n), in random orientations, long along some axes and short along the rest."""
    n, count, long = size
    axes = np.where(np.arange(n) < long, ratio, 1.0)
    turn = np.linalg.qr(rng.normal(size=(DRAWS, count, n, n)))[0] * axes
    return apart * rng.normal(size=(DRAWS, count, n)), turn @ np.swapaxes(turn, -1, -2)


def distances(at: Array, mean: Array, info: Array) -> Array:
    """Squared Mahalanobis distances of points (B, S, n) from the tracks, (B, S, K)."""
    gap = at[:, :, None] - mean[:, None]
    return np.asarray(np.einsum("bski,bkij,bskj->bsk", gap, info, gap))


def sums(at: Array, mean: Array, info: Array, squared: bool) -> Array:
    length = np.arccosh(1.0 + PULL * distances(at, mean, info))
    return np.asarray((length**2 if squared else length).sum(-1))


def meeting(weight: Array, mean: Array, info: Array) -> Array:
    """Where tracks meet at weights (B, S, K), (B, S, n)."""
    total = np.einsum("bsk,bkij->bsij", weight, info)
    return np.asarray(np.linalg.solve(total, np.einsum("bsk,bkij,bkj->bsi", weight, info, mean)[..., None])[..., 0])


def by_random_starts(rng: np.random.Generator, mean: Array, cov: Array, squared: bool) -> Array:
    """Lowest sums, (B,), that the iteration (47) as printed finds from 200 random starts, and at the estimates."""
    info = np.linalg.inv(cov)
    at = meeting(rng.exponential(size=(len(mean), 200, mean.shape[1])) ** 3, mean, info)

    def follow(at: Array, steps: int) -> Array:
        for _ in range(steps):
            z = np.maximum(PULL * distances(at, mean, info), 1e-14)
            weight = 1.0 / np.sqrt(z * (z + 2.0))
            at = meeting(weight * np.arccosh(1.0 + z) if squared else weight, mean, info)
        return at

    at = follow(at, 30)
    best = sums(at, mean, info, squared).argsort(1)[:, :3]
    at = follow(np.take_along_axis(at, best[..., None], 1), 300)
    return np.minimum(sums(at, mean, info, squared).min(1), sums(mean, mean, info, squared).min(1))


@functools.cache
def excess(squared: bool) -> Array:
    """How far above the best of 200 random starts each minimum is, as a share of it."""
    shares = []
    for size in SIZES:
        for ratio, apart in SHAPES:
            rng = np.random.default_rng(1)
            mean, cov = draw(rng, size, ratio, apart)
            found_by_random = by_random_starts(rng, mean, cov, squared)
            ours = nearest_mean(mean, cov, np.full(DRAWS, PULL), squared)
            assert ours.converged.all()
            shares.append(ours.objective / found_by_random - 1.0)
    return np.concatenate(shares)


@pytest.mark.parametrize("squared", [True, False])
def test_the_minimum_is_the_lowest_of_200_random_starts(squared: bool) -> None:
    assert (excess(squared) <= 1e-6).mean() >= 0.98


def test_large_batches_are_cut_into_pieces_of_the_same_minima() -> None:
    rng = np.random.default_rng(3)
    mean, cov = draw(rng, (3, 8, 2), 100.0, 100.0)
    many = np.repeat(mean, 40, 0), np.repeat(cov, 40, 0)
    whole = nearest_mean(*many, np.full(40 * DRAWS, PULL), True)
    few = nearest_mean(mean, cov, np.full(DRAWS, PULL), True)
    np.testing.assert_allclose(whole.objective.reshape(DRAWS, 40), np.tile(few.objective, (40, 1)).T, rtol=1e-12)


def test_of_many_tracks_only_small_sets_are_tried() -> None:
    """Thirty tracks of four axes have 31,930 sets of up to four: singles alone are tried, and the mean is still one."""
    rng = np.random.default_rng(4)
    mean, cov = draw(rng, (4, 30, 3), 100.0, 100.0)
    ours = nearest_mean(mean, cov, np.full(DRAWS, PULL), True)
    info = np.linalg.inv(cov)
    assert (ours.objective <= sums(mean, mean, info, True).min(1)).all()
