"""Gating: which pairs of tracks may be the same target, found without looking at all pairs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from track_fusion.angles import difference
from track_fusion.linalg import Array

Indices = NDArray[np.intp]
Bools = NDArray[np.bool_]
#: Up to so many pairs, all are tried: a tree would cost more than it saves.
TRY_ALL = 4096
#: Of more pairs than this, those whose positions lie too far apart are left out first, which costs little.
TRY_EXACTLY = 64
#: Exact gating works on pieces of so many pairs, to bound memory.
PIECE = 65536
#: Rows that one search of the tree looks for; each may be near every column.
SEARCH_ROWS = 512


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
    row_mean: Array,
    row_cov: Array,
    col_mean: Array,
    col_cov: Array,
    gamma: float,
    position: tuple[int, ...],
    periods: Sequence[float] = (),
    may: Callable[[Indices, Indices], Bools] | None = None,
) -> Candidates:
    """Find all pairs with (x_i - x_j)' (P_i + P_j)^-1 (x_i - x_j) <= gamma, differences the short way round.

    Parameters
    ----------
    row_mean, row_cov : (M, n), (M, n, n)
    col_mean, col_cov : (N, n), (N, n, n)
    gamma : float                 quantile of chi-square with n degrees of freedom
    position : tuple of int       axes that a spatial search may use, none that wraps; empty: try all pairs
    periods : (n,)                of axes that wrap, infinite for the others; empty: none wraps
    may : function or None        of rows and columns of pairs, (P,) each: which of them are looked at; None: all

    Returns
    -------
    Candidates, ordered by row, then column
    """
    if len(row_mean) * len(col_mean) <= TRY_ALL or not position:
        row, col = np.divmod(np.arange(len(row_mean) * len(col_mean)), max(len(col_mean), 1))
        if position and len(row) > TRY_EXACTLY:
            close = _is_close(row_mean, row_cov, col_mean, col_cov, gamma, list(position)).ravel()
            row, col = row[close], col[close]
        pieces = [_looked_at(row[i : i + PIECE], col[i : i + PIECE], may) for i in range(0, max(len(row), 1), PIECE)]
        return joined(*(within(row_mean, row_cov, col_mean, col_cov, *piece, gamma, periods) for piece in pieces))
    near = (_looked_at(*piece, may) for piece in _near(row_mean, row_cov, col_mean, col_cov, gamma, list(position)))
    pairs = joined(*(within(row_mean, row_cov, col_mean, col_cov, *piece, gamma, periods) for piece in near))
    order = np.lexsort((pairs.col, pairs.row))
    return Candidates(pairs.row[order], pairs.col[order], pairs.distance[order], pairs.logdet[order])


def _looked_at(row: Indices, col: Indices, may: Callable[[Indices, Indices], Bools] | None) -> tuple[Indices, Indices]:
    if may is None:
        return row, col
    at = may(row, col)
    return row[at], col[at]


def joined(*parts: Candidates) -> Candidates:
    """Put candidates together, one after the other."""
    if len(parts) == 1:
        return parts[0]
    return Candidates(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in dataclasses.fields(Candidates)))


def within(
    row_mean: Array,
    row_cov: Array,
    col_mean: Array,
    col_cov: Array,
    row: Indices,
    col: Indices,
    gamma: float,
    periods: Sequence[float],
) -> Candidates:
    """Those of the given pairs, row and col (P,), that lie within the gate, in their order; the rest as for `gate`."""
    residual = difference(row_mean[row], col_mean[col], periods)
    lower = np.linalg.cholesky(row_cov[row] + col_cov[col])
    white = np.linalg.solve(lower, residual[..., None])[..., 0]
    distance = (white * white).sum(-1)
    inside = np.flatnonzero(distance <= gamma)
    volume = 2.0 * np.log(np.diagonal(lower[inside], axis1=-2, axis2=-1)).sum(-1)
    return Candidates(row[inside], col[inside], distance[inside], volume)


def _is_close(
    row_mean: Array, row_cov: Array, col_mean: Array, col_cov: Array, gamma: float, position: list[int]
) -> Bools:
    """Tell which positions are close enough for the gate, (M, N): |dp|^2 <= gamma (trace of S), as in `_near`."""
    gap = ((row_mean[:, None, position] - col_mean[:, position]) ** 2).sum(-1)
    row_trace, col_trace = (cov[:, position, position].sum(-1) for cov in (row_cov, col_cov))
    return np.asarray(gap <= gamma * (1.0 + 1e-9) * (row_trace[:, None] + col_trace))


def _near(
    row_mean: Array, row_cov: Array, col_mean: Array, col_cov: Array, gamma: float, position: list[int]
) -> Iterator[tuple[Indices, Indices]]:
    """Pairs whose positions are close enough for the gate, by KD-trees, in pieces.

    The gate implies |dp|^2 <= gamma (largest eigenvalue of S) <= gamma (r_i^2 + r_j^2), r^2 the traces of
    the position blocks. Tracks are binned by r in powers of two, so that a vague track widens the
    search for its own bin only. Only so many rows are searched at once that memory stays bounded however crowded
    the scene is.
    """
    cols = _bins(col_cov, position)
    trees = {k: cKDTree(col_mean[at][:, position]) for k, at in cols.items()}
    yield np.zeros(0, np.intp), np.zeros(0, np.intp)
    for i, of_bin in _bins(row_cov, position).items():
        for start in range(0, len(of_bin), SEARCH_ROWS):
            at = of_bin[start : start + SEARCH_ROWS]
            tree = cKDTree(row_mean[at][:, position])
            for j, other in trees.items():
                reach = np.sqrt(gamma * (4.0 ** (i + 1) + 4.0 ** (j + 1))) * (1.0 + 1e-9)
                pairs = tree.sparse_distance_matrix(other, reach, output_type="ndarray")
                for k in range(0, len(pairs), PIECE):
                    piece = pairs[k : k + PIECE]
                    yield at[piece["i"]], cols[j][piece["j"]]


def _bins(cov: Array, position: list[int]) -> dict[int, Indices]:
    """Group tracks by the power of two below their position radius (trace of the block, square root)."""
    block = cov[:, position, position].sum(-1)
    power = np.floor(0.5 * np.log2(np.maximum(block, np.finfo(float).tiny))).astype(int)
    return {int(k): np.flatnonzero(power == k) for k in np.unique(power)}
