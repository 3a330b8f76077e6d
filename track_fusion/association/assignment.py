"""Global nearest neighbour: the one-to-one assignment of least cost within the gate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, min_weight_full_bipartite_matching

from track_fusion.association.gate import Candidates, Indices, gate
from track_fusion.linalg import Array

#: A component with more cells than this (32 MB of costs) is solved in sparse form.
DENSE_CELLS = 4_000_000
#: The components of so few pairs are found in plain numbers, which spares the overhead of a graph.
FEW_PAIRS = 128


def assign(candidates: Candidates, rows: int, cols: int, gamma: float) -> Indices:
    """Assign rows to columns at least total cost, leaving a row out where that is cheaper.

    Within a connected component of the gating graph, leaving a row out costs gamma plus the component's largest
    ln det S, so that no pair inside the gate costs more than a miss.

    Parameters
    ----------
    candidates : Candidates    pairs within the gate
    rows, cols : int           number of rows and columns
    gamma : float              the gate

    Returns
    -------
    (rows,) int    column of each row, -1 = none
    """
    chosen = np.full(rows, -1, np.intp)
    row, col = candidates.row, candidates.col
    if not len(row):
        return chosen
    alone = (np.bincount(row, minlength=rows)[row] == 1) & (np.bincount(col, minlength=cols)[col] == 1)
    chosen[row[alone]] = col[alone]
    crowded = np.flatnonzero(~alone)
    if len(crowded):
        for pairs in _components(row[crowded], col[crowded], rows, cols):
            at = crowded[pairs]
            _solve(chosen, row[at], col[at], candidates.cost[at], gamma + candidates.logdet[at].max())
    return chosen


def _components(row: Indices, col: Indices, rows: int, cols: int) -> list[NDArray[np.intp]]:
    """Group the pairs by connected component of the bipartite graph."""
    if len(row) <= FEW_PAIRS:
        label = _labels(row.tolist(), (col + rows).tolist())
    else:
        graph = coo_array((np.ones(len(row), np.int8), (row, col + rows)), shape=(rows + cols,) * 2)
        label = np.asarray(connected_components(graph, directed=False)[1][row], np.intp)
    order = np.argsort(label, kind="stable")
    cuts = np.flatnonzero(np.diff(label[order])) + 1
    return list(np.split(order, cuts))


def _labels(first: list[int], second: list[int]) -> NDArray[np.intp]:
    """Label edges between nodes by their component: of each the number of one edge of it."""
    parent = list(range(len(first)))
    edge_of: dict[int, int] = {}

    def root(edge: int) -> int:
        while parent[edge] != edge:
            parent[edge] = edge = parent[parent[edge]]
        return edge

    for edge, ends in enumerate(zip(first, second, strict=True)):
        for node in ends:
            parent[root(edge_of.setdefault(node, edge))] = root(edge)
    return np.array([root(edge) for edge in parent], np.intp)


def _solve(chosen: Indices, row: Indices, col: Indices, cost: Array, miss: float) -> None:
    """Solve one component: columns are its tracks, then a miss for each row."""
    row_of, r = np.unique(row, return_inverse=True)
    col_of, c = np.unique(col, return_inverse=True)
    if len(row_of) * len(col_of) > DENSE_CELLS:
        best = _sparse(r, c, cost, miss, len(row_of), len(col_of))
        chosen[row_of] = np.where(best < len(col_of), np.append(col_of, -1)[np.minimum(best, len(col_of))], -1)
        return
    # Costs count from the miss, so that a forbidden pair, which is no better than a miss, costs nothing.
    table = np.zeros((len(row_of), len(col_of)))
    table[r, c] = np.minimum(cost - miss, -np.finfo(float).tiny)
    best_row, best_col = linear_sum_assignment(table)
    taken = table[best_row, best_col] < 0
    chosen[row_of[best_row[taken]]] = col_of[best_col[taken]]


def _sparse(row: Indices, col: Indices, cost: Array, miss: float, rows: int, cols: int) -> Indices:
    """Solve a crowded component without its full table; a row's private column cols + row is its miss."""
    private = np.arange(rows)
    weight = np.concatenate([cost, np.full(rows, miss)])
    weight += 1.0 - weight.min()  # a zero would read as no edge
    # SciPy 1.11 takes 32-bit indices only.
    at = np.append(row, private).astype(np.int32), np.append(col, cols + private).astype(np.int32)
    graph = coo_array((weight, at), shape=(rows, cols + rows))
    return np.asarray(min_weight_full_bipartite_matching(graph.tocsr())[1], np.intp)


def nearest_neighbour(
    row_mean: Array,
    row_cov: Array,
    col_mean: Array,
    col_cov: Array,
    gamma: float,
    position: tuple[int, ...],
    periods: Sequence[float] = (),
) -> Indices:
    """Gate and assign in one call; arguments as for `gate`, the result as for `assign`."""
    candidates = gate(row_mean, row_cov, col_mean, col_cov, gamma, position, periods)
    return assign(candidates, len(row_mean), len(col_mean), gamma)


def nearest_pairs(first: Array, second: Array, reach: float, power: float = 1.0) -> tuple[Indices, Indices]:
    """Pair points one to one by least total distance, none farther apart than `reach`.

    Parameters
    ----------
    first, second : (M, d), (N, d)    without NaN
    reach : float                     what a point without partner costs in place of a distance
    power : float                     of the distances that are summed

    Returns
    -------
    row, col : (P,) each, ascending rows
    """
    return pairs_within(distances(first, second), reach, power)


def distances(first: Array, second: Array) -> Array:
    """Distance of each point of one set to each of the other: (M, d), (N, d) -> (M, N)."""
    return np.asarray(np.linalg.norm(first[:, None] - second[None], axis=-1))


def pairs_within(distance: Array, reach: float, power: float = 1.0) -> tuple[Indices, Indices]:
    """`nearest_pairs` of points whose distances (M, N) are known."""
    row, col = linear_sum_assignment(np.minimum(distance, reach) ** power)
    near = distance[row, col] < reach
    return row[near], col[near]
