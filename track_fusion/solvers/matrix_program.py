"""Convex programs over a symmetric matrix whose constraints are that other matrices stay positive definite."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from track_fusion.linalg import Array, symmetrise, transpose

#: The duality gap at which a search ends.
GAP = 1e-10
MAX_STEPS = 60
#: Share of the way to the boundary that a step may go.
STAY = 0.95

#: (Y (b, m, m), rows (b,)) -> gradient (b, m, m) of a convex function, and its Hessian as H with the curvature
#: tr(D H D H) along D, or None where it is linear.
Objective = Callable[[Array, NDArray[np.intp]], tuple[Array, Array | None]]


@dataclasses.dataclass(frozen=True)
class Program:
    """Minimise f(Y) where every slack S_k + U_k' D V_k + V_k' D U_k, D = Y - Y_0, is positive definite; B of them.

    Attributes
    ----------
    start : (B, m, m)                 Y_0, symmetric
    slack : (B, K, s, s)              S_k, positive definite: the start is strictly feasible
    left, right : (B, K, m, s)        U, V
    entries : (q, 2)                  the entries of Y, in the upper triangle, that are sought; the others stay
    objective : Objective
    """

    start: Array
    slack: Array
    left: Array
    right: Array
    entries: NDArray[np.intp]
    objective: Objective


@dataclasses.dataclass
class _State:
    """Y, L_k^-1 of each slack L_k L_k', and L_k' Z_k L_k of its multiplier, near mu times one on the central path.

    Kept in this form nothing is badly conditioned near the end.
    """

    y: Array
    whiten: Array
    core: Array


def solve(program: Program) -> tuple[Array, NDArray[np.bool_], NDArray[np.intp]]:
    """Solve a batch of programs by a primal-dual interior point, after Mehrotra.

    Every iterate is strictly feasible: the constraints hold wherever the search stops.

    Returns
    -------
    Y (B, m, m), converged (B,), iterations (B,)
    """
    batch, size = len(program.start), program.slack.shape[-1]
    now = _start(program)
    done, steps = np.zeros(batch, bool), np.zeros(batch, np.intp)
    rows = np.arange(batch)
    for step in range(1, MAX_STEPS + 1):
        if not len(rows):
            break
        part = _State(now.y[rows], now.whiten[rows], now.core[rows])
        move, ds, dz, unroot = _direction(program, part, rows)
        ahead, behind = _reach(ds), _reach(_whitened(unroot, dz))
        now.y[rows] += ahead[:, None, None] * move
        growth: Array = np.asarray(np.linalg.cholesky(np.eye(size) + ahead[:, None, None, None] * ds), np.float64)
        now.whiten[rows] = np.linalg.inv(growth) @ part.whiten
        core = symmetrise(transpose(growth) @ (part.core + behind[:, None, None, None] * dz) @ growth)
        now.core[rows] = core
        finished = (_gap(core) <= GAP) & (np.minimum(ahead, behind) > 0.5)
        done[rows[finished]], steps[rows] = True, step
        rows = rows[~finished]
    return now.y, done, steps


def _start(program: Program) -> _State:
    """Start on multiples of the inverse slacks that fit the gradient as well as one multiple can."""
    whiten: Array = np.asarray(np.linalg.inv(np.linalg.cholesky(program.slack)), np.float64)
    gradient, _ = program.objective(program.start, np.arange(len(program.start)))
    image = _collect(program.left, program.right, transpose(whiten) @ whiten)
    i, j = program.entries.T
    fit = (gradient * image)[:, i, j].sum(1) / (image**2)[:, i, j].sum(1)
    core = np.maximum(fit, 1e-3)[:, None, None, None] * np.eye(whiten.shape[-1])
    return _State(program.start.copy(), whiten, np.broadcast_to(core, whiten.shape).copy())


def _collect(left: Array, right: Array, z: Array) -> Array:
    """Gradient over Y of the sum of tr(Z_k slack_k)."""
    image = (left @ z @ transpose(right)).sum(1)
    return np.asarray(image + transpose(image))


def _direction(program: Program, now: _State, rows: NDArray[np.intp]) -> tuple[Array, Array, Array, Array]:
    """Newton step of Y, and of the slacks and multipliers, whitened by the slacks.

    A first step straight at the end tells how far to aim, and what its second order is. Also returned is the
    whitener of `now.core`.
    """
    left, right = program.left[rows], program.right[rows]
    gradient, bend = program.objective(now.y, rows)
    matrix = _curvature(program.entries, left, right, transpose(now.whiten), now.core, bend)
    i, j = program.entries.T

    def newton(target: Array) -> tuple[Array, Array, Array]:
        force = _collect(left, right, transpose(now.whiten) @ target @ now.whiten) - gradient
        move = np.zeros_like(now.y)
        move[:, i, j] = np.linalg.solve(matrix, 2.0 * force[:, i, j, None])[..., 0]
        move += transpose(move)
        change = transpose(left) @ move[:, None] @ right
        ds = _whitened(now.whiten, change + transpose(change))
        return move, ds, target - now.core - symmetrise(ds @ now.core)

    _, ds, dz = newton(np.zeros_like(now.core))
    unroot = np.linalg.inv(np.linalg.cholesky(now.core))
    ahead, behind = (_reach(change)[:, None, None, None] for change in (ds, _whitened(unroot, dz)))
    gap, one = _gap(now.core), np.eye(ds.shape[-1])
    remains = np.einsum("bkij,bkji->b", one + ahead * ds, now.core + behind * dz) / gap
    aim = np.clip(remains, 0.0, 1.0) ** 3 * gap / (ds.shape[1] * ds.shape[-1])
    return *newton(aim[:, None, None, None] * one - symmetrise(ds @ dz)), unroot


def _curvature(
    entries: NDArray[np.intp], left: Array, right: Array, root: Array, core: Array, bend: Array | None
) -> Array:
    """Matrix of Newton's method, (B, q, q): tr(E_p slack^-1 E_q Z) over the constraints, and the objective's own.

    E_p = U' D_p V + V' D_p U with D_p = e_i e_j' + e_j e_i', so that each is a sum of tr(D_p A D_q B).
    """
    u, v = left @ root, right @ root
    uz, vz = u @ core, v @ core
    first = [v @ transpose(u), v @ transpose(v), u @ transpose(u), u @ transpose(v)]
    second = [vz @ transpose(u), uz @ transpose(u), vz @ transpose(v), uz @ transpose(v)]
    a, b = np.concatenate(first, 1), np.concatenate(second, 1)
    if bend is not None:
        a, b = np.concatenate([a, bend[:, None]], 1), np.concatenate([b, bend[:, None]], 1)
    batch, terms, size, _ = a.shape
    product = (transpose(a.reshape(batch, terms, -1)) @ b.reshape(batch, terms, -1)).reshape(batch, -1)
    (i, j), (k, m) = entries.T[:, :, None], entries.T[:, None]
    total = np.zeros((batch, len(entries) ** 2))
    # tr(D_p A D_q B) is the sum of A[y, s] B[t, x] over (x, y) of D_p and (s, t) of D_q.
    for x, y in ((i, j), (j, i)):
        for s, t in ((k, m), (m, k)):
            total += product[:, (((y * size + s) * size + t) * size + x).ravel()]
    return symmetrise(total.reshape(batch, len(entries), len(entries)))


def _gap(core: Array) -> Array:
    """Sum of the complementarity products of each program."""
    return np.asarray(np.trace(core, axis1=-2, axis2=-1).sum(1))


def _whitened(whiten: Array, change: Array) -> Array:
    return symmetrise(whiten @ change @ transpose(whiten))


def _reach(change: Array) -> Array:
    """Largest step, at most 1, that keeps all of 1 + step * change (B, K, s, s) well positive definite."""
    lowest = np.linalg.eigvalsh(change)[..., 0].min(1)
    with np.errstate(divide="ignore"):
        return np.asarray(np.minimum(1.0, np.where(lowest < 0, -STAY / lowest, 1.0)))
