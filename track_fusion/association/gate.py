"""Gating: which pairs of tracks may be the same target, found without looking at all pairs."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from track_fusion.linalg import Array

Indices = NDArray[np.intp]
#: Up to so many pairs, all are tried: a tree would cost more than it saves.
TRY_ALL = 4096
#: Exact gating works on pieces of so many pairs, to bound memory.
PIECE = 65536


@dataclasses.dataclass(frozen=True)
class Candidates:
    """Pairs within the gate: row and column indices, squared Mahalanobis distance, ln det S; each (P,)."""

    row: Indices
    col: Indices
    distance: Array
    logdet: Array

    @property
    def cost(self) -> Array:
        """Negative log-likelihood of each pair, doubled and without its constant."""
        return self.distance + self.logdet


def gate(
    row_mean: Array, row_cov: Array, col_mean: Array, col_cov: Array, gamma: float, position: tuple[int, ...]
) -> Candidates:
    """Find all pairs with (x_i - x_j)' (P_i + P_j)^-1 (x_i - x_j) <= gamma.

    Parameters
    ----------
    row_mean, row_cov : (M, n), (M, n, n)
    col_mean, col_cov : (N, n), (N, n, n)
    gamma : float                 quantile of chi-square with n degrees of freedom
    position : tuple of int       axes that a spatial search may use; empty: try all pairs

    Returns
    -------
    Candidates, ordered by row, then column
    """
    if len(row_mean) * len(col_mean) <= TRY_ALL or not position:
        grid = np.indices((len(row_mean), len(col_mean))).reshape(2, -1)
        row, col = grid[0], grid[1]
    else:
        row, col = _near(row_mean, row_cov, col_mean, col_cov, gamma, list(position))
    pieces = [
        _exact(row_mean, row_cov, col_mean, col_cov, row[i : i + PIECE], col[i : i + PIECE], gamma)
        for i in range(0, max(len(row), 1), PIECE)
    ]
    return pieces[0] if len(pieces) == 1 else Candidates(*(np.concatenate(c) for c in zip(*pieces, strict=True)))


def _exact(
    row_mean: Array, row_cov: Array, col_mean: Array, col_cov: Array, row: Indices, col: Indices, gamma: float
) -> Candidates:
    residual = row_mean[row] - col_mean[col]
    lower = np.linalg.cholesky(row_cov[row] + col_cov[col])
    white = np.linalg.solve(lower, residual[..., None])[..., 0]
    distance = (white * white).sum(-1)
    inside = distance <= gamma
    volume = 2.0 * np.log(np.diagonal(lower[inside], axis1=-2, axis2=-1)).sum(-1)
    return Candidates(row[inside], col[inside], distance[inside], volume)


def _near(
    row_mean: Array, row_cov: Array, col_mean: Array, col_cov: Array, gamma: float, position: list[int]
) -> tuple[Indices, Indices]:
    """Pairs whose positions are close enough for the gate, by KD-trees.

    The gate implies |dp|^2 <= gamma (largest eigenvalue of S) <= gamma (r_i^2 + r_j^2), r^2 the traces of
    the position blocks. Tracks are binned by r in powers of two, so that a vague track widens the
    search for its own bin only.
    """
    rows = _bins(row_cov, position)
    cols = _bins(col_cov, position)
    found: list[tuple[Indices, Indices]] = []
    trees = {k: cKDTree(col_mean[at][:, position]) for k, at in cols.items()}
    for i, at in rows.items():
        tree = cKDTree(row_mean[at][:, position])
        for j, other in trees.items():
            reach = np.sqrt(gamma * (4.0 ** (i + 1) + 4.0 ** (j + 1))) * (1.0 + 1e-9)
            pairs = tree.sparse_distance_matrix(other, reach, output_type="ndarray")
            found.append((at[pairs["i"]], cols[j][pairs["j"]]))
    row, col = (np.concatenate(c) for c in zip(*found, strict=True))
    order = np.lexsort((col, row))
    return row[order], col[order]


def _bins(cov: Array, position: list[int]) -> dict[int, Indices]:
    """Group tracks by the power of two below their position radius (trace of the block, square root)."""
    block = cov[:, position, position].sum(-1)
    power = np.floor(0.5 * np.log2(np.maximum(block, np.finfo(float).tiny))).astype(int)
    return {int(k): np.flatnonzero(power == k) for k in np.unique(power)}
