"""The mean nearest to K densities by projection distances arccosh(1 + c d_k): Chen and Zhou 2022, section 4.1.

d_k is the squared Mahalanobis distance of the mean from density k.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from track_fusion.linalg import Array, inverse, matvec, outer, solve, transpose

MAX_STEPS = 200
#: A step this short, in standard deviations, or this part of the farthest distance, ends a descent.
SHORT_STEP, ROUNDING = 1e-10, 1e-14
#: Squared criterion: arccosh(1 + c d)^2 is convex in the mean while arccosh <= 2 x, x tanh x = 1. A minimum whose
#: sum of squares is below (2 x)^2 lies where every term is convex, outside which one term alone is larger: no
#: other minimum is lower.
CERTAIN = (2.0 * 1.1996786402577339) ** 2
#: Starts are the intersections of sets of up to n tracks, of as many sizes as give no more sets than this, from one on.
MOST_STARTS = 170
#: So many of them, of least sum, are followed down: with four, 4 of 1800 sums over long tracks that contradict each
#: other ended above a lower minimum.
DESCENTS = 6
#: Numbers in a temporary while starts are chosen.
CHUNK = 100_000
#: Unsquared criterion: a descent leaves an estimate by this many standard deviations.
LEAVE = 1e-3
#: An estimate is the minimum if no descent ends lower than it by more than this part.
TIE = 1e-10
#: An estimate this near, in squared standard deviations, is where the mean is.
HERE = 1e-18


@dataclasses.dataclass(frozen=True)
class ProjectionMean:
    """Nearest means of a batch.

    Attributes
    ----------
    mean : (B, n)
    weights : (B, K)       omega_k of (45), normalised; one at an estimate the mean is snapped to
    distance : (B, K)      d_k
    snapped : (B,)         source whose estimate is the mean, -1 = none
    objective : (B,)       the minimised sum
    converged : (B,)
    iterations : (B,)      steps of the descent that led to the mean
    """

    mean: Array
    weights: Array
    distance: Array
    snapped: NDArray[np.intp]
    objective: Array
    converged: NDArray[np.bool_]
    iterations: NDArray[np.intp]


def nearest_mean(mean: Array, cov: Array, pull: Array, squared: bool) -> ProjectionMean:
    """Minimise the sum over k of arccosh(1 + c d_k), or of its square, over the fused mean, eq. (39).

    Parameters
    ----------
    mean : (B, K, n)
    cov : (B, K, n, n)    by which distances d_k are taken
    pull : (B,)           c
    squared : bool        minimise the sum of squares

    Returns
    -------
    ProjectionMean

    Raises
    ------
    LinAlgError    a matrix is singular

    Notes         Iteration (47) lowers the sum at every step, since each term is concave in d_k; a step of
                  Newton's method replaces it where it lowers the sum further. It starts at the intersection of all
                  tracks, at equal weights, and again at those of up to n tracks, one included, where the sum is
                  least: long tracks that contradict each other have many local minima, near the places where some
                  of them cross. Of the squared sum, which is smooth, the first minimum may be certain to be the lowest.
                  The plain sum has a kink at every estimate x_k, where (48) is infinite: x_k is a local minimum iff
                  sqrt(G' P_k G) <= sqrt(2 c), G the gradient of the other terms. Every estimate competes, and a
                  descent starts beside each that is none.
    References    Z. Chen and J. Zhou, Multisensor Estimation Fusion on Statistical Manifold, 2022, eqs.
                  (39)-(48), Theorem 4; weights (46) are those of (48), for squares phi times its derivative.
    """
    batch, count, n = mean.shape
    if count == 1:
        zeros = np.zeros((batch, 1))
        return ProjectionMean(mean[:, 0].copy(), zeros + 1.0, zeros, np.zeros(batch, np.intp), zeros[:, 0],
                              np.ones(batch, bool), np.zeros(batch, np.intp))  # fmt: skip
    lower = np.linalg.cholesky(cov.sum(1))
    whiten = np.linalg.inv(lower)[:, None]
    white = whiten @ cov @ transpose(whiten)
    origin = mean[:, 0]
    points = matvec(whiten, mean - origin[:, None])
    terms = _Terms(points, inverse(white), pull, squared)
    least = _squared(terms) if squared else _unsquared(terms, white)
    nearest = origin + matvec(lower, least.at)
    snapped = np.flatnonzero(least.snapped >= 0)
    nearest[snapped] = mean[snapped, least.snapped[snapped]]
    return ProjectionMean(
        nearest, least.weights(terms), least.state.distance, least.snapped,
        least.state.value, least.converged, least.iterations,
    )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class _State:
    """What a mean (P, n) costs: value (P,), distances (P, K), and I_k (mean - x_k), (P, K, n)."""

    value: Array
    distance: Array
    force: Array

    def __getitem__(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> _State:
        return _State(self.value[rows], self.distance[rows], self.force[rows])


@dataclasses.dataclass(frozen=True)
class _Terms:
    """The terms of P sums: x_k (P, K, n), inverse covariances (P, K, n, n), c (P,)."""

    points: Array
    info: Array
    pull: Array
    squared: bool

    def __getitem__(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> _Terms:
        return _Terms(self.points[rows], self.info[rows], self.pull[rows], self.squared)

    def state(self, at: Array) -> _State:
        residual = at[:, None] - self.points
        force = matvec(self.info, residual)
        distance = np.maximum((residual * force).sum(-1), 0.0)
        return _State(self.sums(distance), distance, force)

    def sums(self, distance: Array) -> Array:
        """Add up what distances (P, ..., K) cost, (P, ...)."""
        z = self.pull.reshape(-1, *[1] * (distance.ndim - 1)) * distance
        length = np.log1p(z + np.sqrt(z * (z + 2.0)))
        return np.asarray((length**2 if self.squared else length).sum(-1))

    def slopes(self, distance: Array) -> tuple[Array, Array]:
        """Derivatives of each term over z = c d_k: infinite at an estimate if not squared."""
        z = self.pull[:, None] * distance
        sinh = np.sqrt(z * (z + 2.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            if not self.squared:
                return 1.0 / sinh, -(1.0 + z) / sinh**3
            length = np.log1p(z + sinh)
            slope = np.where(sinh > 0, length / sinh, 1.0)
            bend = np.where(z > 1e-6, (1.0 - slope * (1.0 + z)) / sinh**2, -1.0 / 3.0)
        return 2.0 * slope, 2.0 * bend


@dataclasses.dataclass(frozen=True)
class _Minimum:
    """Candidates for the minima of P sums, and how they came about."""

    at: Array
    state: _State
    snapped: NDArray[np.intp]
    converged: NDArray[np.bool_]
    iterations: NDArray[np.intp]

    def replaced(self, rows: NDArray[np.intp], other: _Minimum) -> _Minimum:
        """Put the rows of another in place of these rows."""
        for mine, theirs in zip(self._arrays(), other._arrays(), strict=True):
            mine[rows] = theirs
        return self

    def __getitem__(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> _Minimum:
        at, *state, snapped, converged, iterations = (array[rows] for array in self._arrays())
        return _Minimum(at, _State(*state), snapped, converged, iterations)

    def _arrays(self) -> tuple[NDArray[Any], ...]:
        state = self.state
        return self.at, state.value, state.distance, state.force, self.snapped, self.converged, self.iterations

    def weights(self, terms: _Terms) -> Array:
        slope, _ = terms.slopes(self.state.distance)
        one = np.arange(slope.shape[1]) == self.snapped[:, None]
        slope = np.where((self.snapped >= 0)[:, None], one, slope)
        return np.asarray(slope / slope.sum(-1, keepdims=True))


def _squared(terms: _Terms) -> _Minimum:
    best = _descend(terms, _intersection(terms, np.ones(terms.points.shape[:2])))
    return _restarted(terms, best, np.flatnonzero(best.state.value > CERTAIN))


def _unsquared(terms: _Terms, white: Array) -> _Minimum:
    batch, count, _ = terms.points.shape
    best = _descend(terms, _intersection(terms, np.ones((batch, count))))
    best = _restarted(terms, best, np.arange(batch))
    for source in range(count):
        here = terms.points[:, source]
        direction = _way_down(terms, white, source)
        rows = np.flatnonzero(direction.any(-1))
        if len(rows):
            best = _better(best, rows, _descend(terms[rows], here[rows] + LEAVE * direction[rows]))
    states = [terms.state(terms.points[:, source]) for source in range(count)]
    source = np.stack([s.value for s in states]).argmin(0)
    here = np.take_along_axis(terms.points, source[:, None, None], 1)[:, 0]
    sure = np.ones(batch, bool)
    snap = _Minimum(here, terms.state(here), source, sure, best.iterations.copy())
    # The mean is that estimate, not a point reached to rounding, wherever no descent ends lower.
    at_it = snap.state.value <= best.state.value * (1.0 + TIE)
    return best.replaced(np.flatnonzero(at_it), snap[at_it])


def _better(best: _Minimum, rows: NDArray[np.intp], other: _Minimum) -> _Minimum:
    """Put minima of these rows in place of the best that are clearly higher."""
    lower = other.state.value < best.state.value[rows] * (1.0 - TIE)
    return best.replaced(rows[lower], other[lower])


# Where descents start.


def _restarted(terms: _Terms, best: _Minimum, rows: NDArray[np.intp]) -> _Minimum:
    """Descend from the most promising intersections of few tracks, and keep the best minimum of these rows."""
    _, count, n = terms.points.shape
    # At an estimate the plain sum has a kink, which a descent does not leave.
    sets = _sets(count, n, 1 if terms.squared else 2)
    if not len(sets):
        return best
    for piece in _pieces(rows, len(sets) * n * n):
        part = terms[piece]
        starts = _promising(part, sets)
        kept = starts.shape[1]
        ends = _descend(part[np.repeat(np.arange(len(piece)), kept)], starts.reshape(-1, n))
        lowest = ends.state.value.reshape(-1, kept).argmin(1)
        best = _better(best, piece, ends[np.arange(len(piece)) * kept + lowest])
    return best


@functools.lru_cache
def _sets(count: int, n: int, least: int) -> Array:
    """List sets of `least` to n tracks, but never all, as rows (S, K) of zeros and ones, no more than MOST_STARTS."""
    sizes = range(1, min(n, count - 1) + 1)
    totals = itertools.accumulate(math.comb(count, size) for size in sizes)
    few = [size for size, total in zip(sizes, totals, strict=True) if total <= MOST_STARTS and size >= least]
    chosen = [members for size in few for members in itertools.combinations(range(count), size)]
    sets = np.zeros((len(chosen), count))
    for row, members in zip(sets, chosen, strict=True):
        row[list(members)] = 1.0
    return sets


def _promising(terms: _Terms, sets: Array) -> Array:
    """Intersections of sets of tracks (S, K) with the least sums, at most DESCENTS a sum, (P, D, n)."""
    batch, count, n = terms.points.shape
    flat = terms.info.reshape(batch, count, n * n)
    force = matvec(terms.info, terms.points)
    total = (sets @ flat).reshape(batch, len(sets), n, n)
    starts = solve(total, (sets @ force)[..., None])[..., 0]
    if len(sets) <= DESCENTS:
        return starts
    # (x - x_k)' I_k (x - x_k), multiplied out: its digits are lost where they do not matter.
    square = outer(starts).reshape(batch, len(sets), n * n) @ transpose(flat)
    distance = square - 2.0 * starts @ transpose(force) + (terms.points * force).sum(-1)[:, None]
    value = terms.sums(np.maximum(distance, 0.0))
    least = np.argpartition(value, DESCENTS, 1)[:, :DESCENTS]
    return np.take_along_axis(starts, least[..., None], 1)


def _pieces(rows: NDArray[np.intp], numbers: int) -> Iterator[NDArray[np.intp]]:
    """Cut rows, of so many numbers each, into pieces of at most CHUNK numbers."""
    step = max(1, CHUNK // numbers)
    for start in range(0, len(rows), step):
        yield rows[start : start + step]


def _way_down(terms: _Terms, white: Array, source: int) -> Array:
    """Steepest way down from an estimate, one standard deviation long, (B, n); zero where it is a local minimum.

    The kinks of estimates that coincide add up.
    """
    state = terms.state(terms.points[:, source])
    apart = state.distance > HERE
    slope = np.where(apart, terms.slopes(state.distance)[0], 0.0)
    gradient = 2.0 * (terms.pull[:, None] * slope)[..., None] * state.force
    gradient = np.where(apart[..., None], gradient, 0.0).sum(1)
    image = matvec(white, gradient[:, None])
    size = np.sqrt(np.maximum((image * gradient[:, None]).sum(-1), 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        # sum of sqrt(2 c) / |G|_k over the kinks here: at least one where they hold the mean.
        hold = np.where(apart, 0.0, np.sqrt(2.0 * terms.pull)[:, None] / size).sum(-1)
        direction = -image[:, source] / size[:, source, None]
    return np.where((hold < 1.0)[:, None], direction, 0.0)


def _intersection(terms: _Terms, weights: Array) -> Array:
    """Mean (45) at these weights, (P, n)."""
    info = weights[..., None, None] * terms.info
    return np.asarray(np.linalg.solve(info.sum(1), matvec(info, terms.points).sum(1)[..., None])[..., 0])


def _descend(terms: _Terms, start: Array) -> _Minimum:
    """Follow each sum down from its start, (P, n), by (47) and Newton's method."""
    batch = len(start)
    rows, part, at, state = np.arange(batch), terms, start, terms.state(start)
    end = _Minimum(start.copy(), state[rows], np.full(batch, -1), np.zeros(batch, bool), np.zeros(batch, np.intp))
    metric = terms.info.mean(1)
    for step in range(1, MAX_STEPS + 1):
        if not len(rows):
            break
        new, new_state, halted = _step(part, at, state)
        move = new - at
        length = np.sqrt(np.maximum((move * matvec(metric, move)).sum(-1), 0.0))
        done = halted | (length <= SHORT_STEP + ROUNDING * np.sqrt(new_state.distance.max(-1)))
        at, state = new, new_state
        if done.any() or step == MAX_STEPS:
            out = done | (step == MAX_STEPS)
            count = int(out.sum())
            end.replaced(rows[out], _Minimum(at[out], state[out], np.full(count, -1), done[out], np.full(count, step)))
            left = ~out
            rows, part, at, state, metric = rows[left], part[left], at[left], state[left], metric[left]
    return end


def _step(terms: _Terms, at: Array, state: _State) -> tuple[Array, _State, NDArray[np.bool_]]:
    """Take the better of (47) and a step of Newton's method; halt at an estimate that has a kink."""
    halted: NDArray[np.bool_] = np.asarray((state.distance <= HERE).any(-1) & (not terms.squared))
    slope, bend = terms.slopes(np.where(halted[:, None], 1.0, state.distance))
    pull = terms.pull[:, None]
    gradient = (slope[..., None] * state.force).sum(1)
    tame = (slope[..., None, None] * terms.info).sum(1)
    hessian = tame + 2.0 * ((pull * bend)[..., None, None] * outer(state.force)).sum(1)
    moves = [_solve(matrix, gradient) for matrix in (tame, hessian)]
    plain, newton = (np.where(halted[:, None], at, at - move) for move in moves)
    plain_state, newton_state = terms.state(plain), terms.state(newton)
    better = newton_state.value <= plain_state.value
    new = np.where(better[:, None], newton, plain)
    pairs = zip(vars(newton_state).values(), vars(plain_state).values(), strict=True)
    value, distance, force = (np.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in pairs)
    return new, _State(value, distance, force), halted


def _solve(matrix: Array, right: Array) -> Array:
    """Solve, giving infinity where a matrix is singular: no candidate."""
    try:
        return np.asarray(np.linalg.solve(matrix, right[..., None])[..., 0])
    except np.linalg.LinAlgError:
        if len(matrix) == 1:
            return np.full_like(right, np.inf)
        half = len(matrix) // 2
        return np.concatenate([_solve(matrix[:half], right[:half]), _solve(matrix[half:], right[half:])])
