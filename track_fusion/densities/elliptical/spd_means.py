"""Means of symmetric positive definite matrices: Riemannian (Karcher) and log-Euclidean, for a whole batch."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from track_fusion.linalg import Array, inverse, symmetrise, transpose
from track_fusion.solvers.pair import SHARP, Pair

#: Newton's method squares the error of a step: after one this short, in log scale, the mean is exact.
SHORT_STEP = 1e-6
MAX_NEWTON = 50
#: Conjugate gradients solve for a step to this share of its length, or to its square if that is longer.
INNER_TOLERANCE, MAX_INNER = 1e-8, 60
#: A step that does not lower the gradient is cut to this share.
SHORTEN = 0.5
#: The batch is worked on in pieces whose arrays stay in the cache.
CHUNK = 256


@dataclasses.dataclass(frozen=True)
class SpdMean:
    """Means (B, n, n), with what became of the iteration: converged and iterations (B,)."""

    mean: Array
    converged: NDArray[np.bool_]
    iterations: NDArray[np.intp]


def log_euclidean_mean(matrices: Array) -> Array:
    """Log-Euclidean mean Exp(mean of Log P_k), Chen 2022 (64).

    Parameters
    ----------
    matrices : (..., K, n, n)    symmetric positive definite

    Returns
    -------
    (..., n, n)

    Notes         Depends on the axes: it is equivariant under rotations and a change of unit common to all
                  axes only. Eigenvalues below 1e-16 of the largest are noise.
    References    Z. Chen and J. Zhou, Multisensor Estimation Fusion on Statistical Manifold, 2022, eq. (64).
    """
    values, vectors = np.linalg.eigh(matrices)
    # The scale of all eigenvalues is taken out; an eigenvalue that rounding made negative counts as rounding.
    top = values[..., -1:]
    logs = np.log(np.maximum(values, np.finfo(float).eps * top))
    total = ((vectors * logs[..., None, :]) @ transpose(vectors)).mean(-3)
    mean_logs, basis = np.linalg.eigh(total)
    return symmetrise((basis * np.exp(mean_logs)[..., None, :]) @ transpose(basis))


def karcher_mean(matrices: Array) -> SpdMean:
    """Riemannian barycenter of positive definite matrices: sum of Log(P_k^-1 S) = 0, Chen 2022 (58).

    Parameters
    ----------
    matrices : (B, K, n, n)    symmetric positive definite

    Returns
    -------
    SpdMean    mean (B, n, n): the one minimiser, which moves with every change of axes

    Raises
    ------
    LinAlgError    a matrix is singular

    Notes          Two matrices have the closed form P1 # P2. For more, Newton's method in the axes in which
                   the present mean is the unit matrix, each step solved by conjugate gradients, from the
                   mean A # H of the arithmetic and the harmonic mean; a step is cut where the gradient would
                   not fall. K eigendecompositions a step, some four steps.
    References     Z. Chen and J. Zhou, Multisensor Estimation Fusion on Statistical Manifold, 2022, eqs.
                   (58)-(59), whose sign must be that of Log(S^-1 P_k); D. Bini and B. Iannazzo, Computing the
                   Karcher mean of symmetric positive definite matrices, 2013.
    """
    count = len(matrices)
    if matrices.shape[1] == 1:
        return SpdMean(matrices[:, 0].copy(), np.ones(count, bool), np.zeros(count, np.intp))
    if matrices.shape[1] == 2:
        return SpdMean(_midpoint(matrices[:, 0], matrices[:, 1]), np.ones(count, bool), np.zeros(count, np.intp))
    if count <= CHUNK:
        return _karcher(matrices)
    parts = [_karcher(matrices[i : i + CHUNK]) for i in range(0, count, CHUNK)]
    fields = [f.name for f in dataclasses.fields(SpdMean)]
    return SpdMean(*(np.concatenate([getattr(p, f) for p in parts]) for f in fields))


def _midpoint(first: Array, second: Array) -> Array:
    """Return P1 # P2, (B, n, n)."""
    pair = Pair.of(first, second)
    mean = pair.rebuild(np.sqrt(pair.first) * np.sqrt(pair.second))
    same = (first == second).all((-2, -1))
    mean[same] = first[same]
    return mean


def _karcher(matrices: Array) -> SpdMean:
    """Karcher mean of a piece of a batch."""
    batch = len(matrices)
    result = np.empty((batch, *matrices.shape[-2:]))
    converged, iterations = np.zeros(batch, bool), np.zeros(batch, np.intp)
    rows = np.arange(batch)
    factor, back = _start(matrices)
    length, step = np.full(batch, np.inf), np.zeros_like(result)
    size = np.ones(batch)
    for count in range(1, MAX_NEWTON + 1):
        if not len(rows):
            break
        new_factor, new_back = _moved(factor, back, step * size[:, None, None])
        logs, vectors = _logs(new_back, matrices[rows])
        gradient = _rebuilt(logs, vectors).mean(1)
        new_length = _norm(gradient)
        # Near the end rounding, not the step, decides whether the gradient falls.
        better = (new_length < length) | (new_length <= SHORT_STEP)
        size = np.where(better, 1.0, SHORTEN * size)
        keep = better[:, None, None]
        factor, back, length = np.where(keep, new_factor, factor), np.where(keep, new_back, back), \
            np.where(better, new_length, length)  # fmt: skip
        step = np.where(keep, _newton_step(logs, vectors, gradient), step)
        done = (length <= SHORT_STEP) | (size < np.finfo(float).eps)
        if done.any() or count == MAX_NEWTON:
            last, _ = _moved(factor, back, step)
            out = done | (count == MAX_NEWTON)
            result[rows[out]] = symmetrise(last[out] @ transpose(last[out]))
            converged[rows[out]], iterations[rows[out]] = (length <= SHORT_STEP)[out], count
            left = ~out
            rows, factor, back, step = rows[left], factor[left], back[left], step[left]
            length, size = length[left], size[left]
    return SpdMean(result, converged, iterations)


def _start(matrices: Array) -> tuple[Array, Array]:
    """Return W and W^-1 of A # H = W W', A the arithmetic and H the harmonic mean."""
    pair = Pair.of(matrices.mean(1), inverse(inverse(matrices).mean(1)))
    root = (pair.first * pair.second).T ** 0.25
    return pair.basis * root[:, None, :], pair.inverse / root[:, :, None]


def _moved(factor: Array, back: Array, step: Array) -> tuple[Array, Array]:
    """Return W and W^-1 of W Exp(step) W'."""
    values, vectors = np.linalg.eigh(step)
    grow = np.exp(0.5 * values)
    return (factor @ vectors) * grow[..., None, :], (transpose(vectors) @ back) / grow[..., :, None]


def _logs(back: Array, matrices: Array) -> tuple[Array, Array]:
    """Logarithms of the eigenvalues, (B, K, n), and eigenvectors of W^-1 P_k W^-T."""
    white = symmetrise(back[:, None] @ matrices @ transpose(back)[:, None])
    values, vectors = np.linalg.eigh(white)
    spread = np.argwhere(values[..., 0] < SHARP * values[..., -1])
    if len(spread):
        # The small eigenvalues have lost half their digits: take them as squares of singular values.
        row, source = spread.T
        u, s, _ = np.linalg.svd(back[row] @ np.linalg.cholesky(matrices[row, source]))
        values[row, source], vectors[row, source] = s**2, u
    return np.log(values), vectors


def _rebuilt(values: Array, vectors: Array) -> Array:
    return np.asarray((vectors * values[..., None, :]) @ transpose(vectors))


def _newton_step(logs: Array, vectors: Array, gradient: Array) -> Array:
    """Solve Hessian X = gradient by conjugate gradients, (B, n, n).

    In the eigenbasis of one Log P_k, with eigenvalues l, its share of the Hessian multiplies entry (i, j) by
    x coth x, x = (l_i - l_j) / 2, which is at least 1.
    """
    half = 0.5 * (logs[..., :, None] - logs[..., None, :])
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = np.where(np.abs(half) < 1e-4, 1.0 + half**2 / 3.0, half / np.tanh(half))
    back = transpose(vectors)

    def hessian(x: Array) -> Array:
        return np.asarray((vectors @ (weight * (back @ x[:, None] @ vectors)) @ back).mean(1))

    x, residual = np.zeros_like(gradient), gradient.copy()
    direction, square = residual, _dot(residual, residual)
    length = np.sqrt(square)
    target = (length * np.maximum(INNER_TOLERANCE, np.minimum(0.1, length))) ** 2
    for _ in range(MAX_INNER):
        open_rows = square > target
        if not open_rows.any():
            break
        image = hessian(direction)
        # A solved row stays as it is, so that no row depends on the others of its batch.
        share = np.where(open_rows, square / np.maximum(_dot(direction, image), np.finfo(float).tiny), 0.0)
        x = x + share[:, None, None] * direction
        residual = residual - share[:, None, None] * image
        new = _dot(residual, residual)
        direction = residual + (new / np.maximum(square, np.finfo(float).tiny))[:, None, None] * direction
        square = new
    return symmetrise(x)


def _dot(a: Array, b: Array) -> Array:
    return np.asarray((a * b).sum((-2, -1)))


def _norm(a: Array) -> Array:
    return np.sqrt(_dot(a, a))
