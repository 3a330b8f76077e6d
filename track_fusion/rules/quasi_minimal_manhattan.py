"""Quasi-minimal Manhattan distance: the intersection at the weights whose result is nearest to all tracks."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.elliptical.rao import manhattan_paths
from track_fusion.linalg import Array, cholesky, inverse, matvec, symmetrise, transpose, whitener
from track_fusion.rules.base import Example, FusedTracks, Rule, SourceTracks
from track_fusion.rules.shared.elliptical import HEAVY_TAILS, EllipticalParams, each, family_of
from track_fusion.rules.shared.weights import pooled_by
from track_fusion.solvers.least_squares import minimise_squares_on_simplex
from track_fusion.solvers.optimise import Solution

#: A search that starts from one track gives it this weight.
LEAN = 0.9
#: Sums that differ by less, relatively, are equal.
TIE = 1e-9
#: The batch is worked on in pieces whose largest arrays hold no more numbers than this, to stay in the cache.
CHUNK_NUMBERS = 2**16


def fuse(tracks: SourceTracks, params: EllipticalParams) -> FusedTracks:
    """Fuse K elliptical tracks by the intersection whose minimal Manhattan distances to them are least.

    The weights minimise the sum of the squares of the distances (28) from each track to the fused one. Promises
    nothing about the tracks' cross-correlation.

    Parameters
    ----------
    tracks : SourceTracks    mean (..., K, n), cov (..., K, n, n), dof (..., K) or None
    params : EllipticalParams

    Returns
    -------
    FusedTracks    mean (..., n), cov (..., n, n), weights (..., K), dof (...): the least dof of a target's tracks for
                   family student_t, else None. info: converged, iterations

    Raises
    ------
    ValueError     beta is given for another family, or too small
    LinAlgError    a covariance is singular

    Notes          The paper names the rule without its equations: this reading has its form (45) and its place
                   among the rules. The sum is not convex; the search starts from equal weights and from each
                   track. No guarantee: if a random pair of three tracks of variance 1 shares an error of 10 in
                   1.5 % of all cases and all else is exact, the mean follows the pair, and the mean square
                   error is 1.26 times the covariance claimed. K + 1 searches of some ten steps of K^2 n^3.
    References     X. Chen et al., Upper bounds for Rao distance on the manifold of multivariate elliptical
                   distributions, 2021; X. Chen and J. Zhou, Multisensor Estimation Fusion on Statistical Manifold,
                   2022, eqs. (27)-(28), (45).
    """
    family, dof = family_of(tracks, params)
    constants = [each(tracks, v) for v in (family.pull * family.kappa, family.radius_squared, 2.0 * family.b)]

    def find(mean: Array, cov: Array) -> Solution:
        count, n = mean.shape[1:]
        chunk = max(1, CHUNK_NUMBERS // ((count + 1) * count * n * n))
        pieces = [slice(i, i + chunk) for i in range(0, max(len(mean), 1), chunk)]
        return Solution.concatenate([_weights(mean[s], cov[s], *(v[s] for v in constants)) for s in pieces])

    return dataclasses.replace(pooled_by(find, tracks), dof=dof)


def _weights(mean: Array, cov: Array, pull: Array, radius: Array, weight: Array) -> Solution:
    """Find the weights of a flat batch, mean (B, K, n); pull is c kappa."""
    count = mean.shape[1]
    if count == 1:
        return Solution.known(np.ones((len(mean), 1)))
    distances = _Distances.of(mean, cov, pull, radius, weight)
    lean = np.where(np.eye(count, dtype=bool), LEAN, (1.0 - LEAN) / (count - 1))
    starts = np.concatenate([np.full((1, count), 1.0 / count), lean])
    batch, searches = len(mean), count + 1
    # All searches of the batch at once, the fusions running fastest.
    search, value = minimise_squares_on_simplex(
        lambda w, rows: distances(w, rows % batch), np.repeat(starts, batch, axis=0)
    )
    value = value.reshape(searches, batch)
    # The first search wins unless another is lower by more than rounding.
    value[1:] = np.where(value[1:] < value[0] * (1.0 - TIE), value[1:], np.inf)
    best = value.argmin(0) * batch + np.arange(batch)
    return search[best]


@dataclasses.dataclass(frozen=True)
class _Distances:
    """The distances (28) of K tracks to their intersection as functions of its weights, in whitened axes.

    points (B, K, n), info and root (B, K, n, n): inverse and Cholesky factor of the covariances; pull, radius,
    weight (B,).
    """

    points: Array
    info: Array
    root: Array
    pull: Array
    radius: Array
    weight: Array

    @classmethod
    def of(cls, mean: Array, cov: Array, pull: Array, radius: Array, weight: Array) -> _Distances:
        whiten = whitener(cov.sum(1))[:, None]
        white = symmetrise(whiten @ cov @ transpose(whiten))
        points = matvec(whiten, mean - mean[:, :1])
        return cls(points, inverse(white), cholesky(white), pull, radius, weight)

    def __call__(self, w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        points, info, root = self.points[rows], self.info[rows], self.root[rows]
        batch, count, n = points.shape
        fused = inverse((w[..., None, None] * info).sum(1))
        mean = matvec(fused, (w[..., None] * matvec(info, points)).sum(1))
        residual = mean[:, None] - points
        force = matvec(info, residual)
        distance = (residual * force).sum(-1)
        logs, basis = _log_ratios(root, fused)
        mean_log = logs.mean(-1)
        rest = logs - mean_log[..., None]
        pull, radius, weight = (np.repeat(v[rows], count) for v in (self.pull, self.radius, self.weight))
        z = pull * np.maximum(distance, 0.0).ravel()
        deviation = np.sqrt((rest**2).sum(-1)).ravel()
        paths = manhattan_paths(z, mean_log.ravel(), deviation, radius, weight)
        # Along weight j the mean moves by -P I_j (mean - x_j), P by -P I_j P.
        shift = -matvec(fused[:, None], force)
        over_mean = 2.0 * (pull * paths.over_z).reshape(batch, count, 1) * force
        shrink = -(basis * (rest * np.exp(logs))[..., None, :]) @ transpose(basis)
        over_cov = paths.over_deviation.reshape(batch, count, 1, 1) * shrink
        over_cov = over_cov - (paths.over_log.reshape(batch, count, 1, 1) / n) * fused[:, None]
        flat = over_cov.reshape(batch, count, n * n) @ transpose(info.reshape(batch, count, n * n))
        return paths.length.reshape(batch, count), over_mean @ transpose(shift) + flat


def _log_ratios(root: Array, fused: Array) -> tuple[Array, Array]:
    """Logarithms of the eigenvalues of P_k^-1 P, (B, K, n), and C_k V, V their vectors in the axes of C_k = root."""
    back: Array = np.asarray(np.linalg.inv(root), np.float64)
    values, vectors = np.linalg.eigh(symmetrise(back @ fused[:, None] @ transpose(back)))
    return np.log(np.maximum(values, np.finfo(float).tiny)), root @ vectors


RULE = Rule(
    key="quasi_minimal_manhattan",
    title="Quasi-minimal Manhattan distance",
    fuse=fuse,
    params=EllipticalParams,
    family="elliptical",
    arity="n_ary",
    guarantee="none",
    caveat="weights follow the means: a rare large error that most tracks share exceeds what is claimed by 26 %",
    source="Chen 2022 (27)-(28), (45), section 5",
    cost="K^3 n^3, about twenty times",
    example=Example(({}, HEAVY_TAILS), idempotent=True),
)
