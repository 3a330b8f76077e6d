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

#: So few components, of so few pairs, are solved one by one by their full tables; more of them at once, in sparse form.
FEW_COMPONENTS = 8
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
    row, col, cost = candidates.row, candidates.col, candidates.cost
    order = np.lexsort((cost, row))
    best = order[np.diff(row[order], prepend=-1) > 0]
    # What is best for every row is best in all, where no two rows want the same column.
    chosen[row[best]] = col[best]
    contested = np.bincount(col[best], minlength=cols) > 1
    if contested.any():
        label = _components(row, col, rows, cols)
        at = np.flatnonzero(np.isin(label, label[contested[col]]))
        chosen[row[at]] = -1
        row_of, col_of = _solved(row[at], col[at], label[at], cost[at], gamma + candidates.logdet[at])
        chosen[row_of] = col_of
    return chosen


def _solved(row: Indices, col: Indices, label: Indices, cost: Array, miss: Array) -> tuple[Indices, Indices]:
    """Solve components, (P,) labels of their pairs: which rows are assigned, and to which columns."""
    components, label = np.unique(label, return_inverse=True)
    most = np.full(len(components), -np.inf)
    np.maximum.at(most, label, miss)
    # Costs count from the miss, so that a forbidden pair, which is no better than a miss, costs nothing.
    gain = np.minimum(cost - most[label], -np.finfo(float).tiny)
    if len(components) > FEW_COMPONENTS or len(row) > FEW_PAIRS:
        return _sparse(row, col, gain)
    parts = [_dense(row[at], col[at], gain[at]) for at in (label == k for k in range(len(components)))]
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])


def _components(row: Indices, col: Indices, rows: int, cols: int) -> Indices:
    """Label the connected components of the bipartite graph: that of each pair, (P,)."""
    if len(row) <= FEW_PAIRS:
        return _labels(row.tolist(), (col + rows).tolist())
    graph = coo_array((np.ones(len(row), np.int8), (row, col + rows)), shape=(rows + cols,) * 2)
    return np.asarray(connected_components(graph, directed=False)[1][row], np.intp)


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


def _dense(row: Indices, col: Indices, gain: Array) -> tuple[Indices, Indices]:
    """Solve one component by its full table: which rows are assigned, and to which columns."""
    row_of, r = np.unique(row, return_inverse=True)
    col_of, c = np.unique(col, return_inverse=True)
    table = np.zeros((len(row_of), len(col_of)))
    table[r, c] = gain
    best_row, best_col = linear_sum_assignment(table)
    taken = table[best_row, best_col] < 0
    return row_of[best_row[taken]], col_of[best_col[taken]]


def _sparse(row: Indices, col: Indices, gain: Array) -> tuple[Indices, Indices]:
    """Solve any number of components at once, without tables; of each row a private column is its miss."""
    row_of, r = np.unique(row, return_inverse=True)
    col_of, c = np.unique(col, return_inverse=True)
    private = np.arange(len(row_of))
    weight = np.concatenate([gain, np.zeros(len(row_of))])
    weight += 1.0 - weight.min()  # a zero would read as no edge
    # SciPy 1.11 takes 32-bit indices only.
    at = np.append(r, private).astype(np.int32), np.append(c, len(col_of) + private).astype(np.int32)
    graph = coo_array((weight, at), shape=(len(row_of), len(col_of) + len(row_of)))
    best = min_weight_full_bipartite_matching(graph.tocsr())[1]
    taken = best < len(col_of)
    return row_of[taken], col_of[best[taken]]


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
