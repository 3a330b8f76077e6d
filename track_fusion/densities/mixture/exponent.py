"""Algorithm 1 of Ahmed: the exponent of a weighted exponential product of mixtures, by samples, and its error."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.log_domain import normalised
from track_fusion.densities.mixture.algebra import LogMixture, power, product
from track_fusion.densities.mixture.mixture import Factored, Mixture, sample
from track_fusion.densities.mixture.sampling import Weighted
from track_fusion.linalg import Array
from track_fusion.solvers.optimise import minimise_on_interval

#: Exponent of the proposal; the paper's choice.
PROPOSAL_OMEGA = 0.5
#: The samples are dealt out to so many batches, whose spread is the error of omega.
BATCHES = 20
#: The error that is told is so many standard errors: 95 % of all omegas are nearer.
STANDARD_ERRORS = 2.0
#: Numbers kept at once while more samples are drawn.
CHUNK = 6_000_000


class Omega(NamedTuple):
    """What Algorithm 1 gives.

    Attributes
    ----------
    omega : (...)
    error : (...)        two standard errors of it; zero where it is given
    samples : Weighted   the first `count` samples, weighted for this omega
    converged : (...)    the search ended, and the error is no more than was asked for
    iterations : (...)
    """

    omega: Array
    error: Array
    samples: Weighted
    converged: NDArray[np.bool_]
    iterations: NDArray[np.intp]


def optimise_omega(
    first: Mixture,
    second: Mixture,
    rng: np.random.Generator,
    count: int,
    criterion: str = "chernoff",
    omega: Array | None = None,
    proposal: Mixture | None = None,
    tolerance: float = 1.0,
    most: int = 0,
) -> Omega:
    """Algorithm 1: find the exponent of the weighted exponential product and samples of it.

    Parameters
    ----------
    first, second : Mixture    (..., C1), (..., C2), normalised; the leading axes are equal
    rng, count                 generator and number of samples
    criterion : str            chernoff (9), minimax_information_loss (11)
    omega : (...) or None      given exponent, instead of any criterion
    proposal : Mixture or None what is drawn from, q (..., C); by default :func:`overlap_proposal`
    tolerance : float          while the error of omega is larger, the samples are doubled
    most : int                 as long as there are no more than this

    Returns
    -------
    Omega    the samples' weights are p_i^omega p_j^(1 - omega) / q

    Notes         On fixed samples both criteria are convex and smooth in omega: Newton's method. At the minimum the
                  mean over a batch of samples of each one's part in the slope, over the curvature, is how far the
                  batch would move omega; these spread, on the same samples for all omegas, as omega does.
                  Samples beyond the first come from a generator of their own.
    References    N. R. Ahmed, Decentralized Gaussian Mixture Fusion through Unified Quotient Approximations,
                  Algorithm 1, eqs. (8)-(11), (18)-(21), kappa of (21) normalised.
    """
    problem = _Problem(first, second, overlap_proposal(first, second) if proposal is None else proposal)
    points = sample(problem.proposal, rng, count).points
    logs = problem.logs(points)
    lead = logs.first.shape[:-1]
    if omega is None:
        best = _search(logs.flat, criterion)
        doubtful = np.flatnonzero(best.error > tolerance)
        doublings = max(most // count, 1).bit_length() - 1
        seeds = list(rng.spawn(1)[0].integers(1 << 63, size=doublings))
        step = max(1, CHUNK // max(3 * most, 1))
        for rows in (doubtful[at : at + step] for at in range(0, len(doubtful), step)):
            best.replace(rows, _with_more(problem.flat(lead).at(rows), logs.flat.at(rows), seeds, criterion, tolerance))
        solution = best.shaped(lead)
    else:
        solution = _Search(omega, np.zeros(lead), np.ones(lead, bool), np.zeros(lead, np.intp))
    converged = solution.converged & (solution.error <= tolerance)
    return Omega(solution.omega, solution.error, logs.weighted(points, solution.omega), converged, solution.iterations)


def overlap_proposal(first: Mixture, second: Mixture) -> Mixture:
    """Component-wise product (..., C1 C2) of powers at 1/2, (49)-(51) of Li 2019, for Algorithm 1 to draw from.

    It has the components of (14)-(16) of Ahmed, but weights that count their overlap, and lies above the target at 1/2
    up to a constant, so that importance weights are bounded there.
    """
    powers = power(LogMixture.of(first), PROPOSAL_OMEGA), power(LogMixture.of(second), 1.0 - PROPOSAL_OMEGA)
    return product(*powers).normalised


class _Logs(NamedTuple):
    """Logarithms (..., S) of both densities and of the proposal at samples of it."""

    first: Array
    second: Array
    proposal: Array

    @property
    def flat(self) -> _Logs:
        return _Logs(*(a.reshape(math.prod(a.shape[:-1]), a.shape[-1]) for a in self))

    def at(self, rows: NDArray[np.intp]) -> _Logs:
        return _Logs(*(a[rows] for a in self))

    def weighted(self, points: Array, omega: Array) -> Weighted:
        """Weight samples for the product at omega (...)."""
        share = omega[..., None]
        return Weighted(points, share * self.first + (1.0 - share) * self.second - self.proposal)


@dataclasses.dataclass(frozen=True)
class _Problem:
    """Two mixtures (..., C1) and (..., C2), and what is drawn from."""

    first: Mixture
    second: Mixture
    proposal: Mixture

    def logs(self, points: Array) -> _Logs:
        return _Logs(*(Factored.of(m).log_pdf(points) for m in (self.first, self.second, self.proposal)))

    def flat(self, lead: tuple[int, ...]) -> _Problem:
        """Make leading axes one."""
        size = math.prod(lead)
        return self._each(lambda m: Mixture(*(a.reshape(size, *a.shape[len(lead) :]) for a in vars(m).values())))

    def at(self, rows: NDArray[np.intp]) -> _Problem:
        return self._each(lambda m: m.at(rows))

    def _each(self, change: Callable[[Mixture], Mixture]) -> _Problem:
        return _Problem(change(self.first), change(self.second), change(self.proposal))


@dataclasses.dataclass(frozen=True)
class _Search:
    """Omegas (...) with their errors, and how the search went."""

    omega: Array
    error: Array
    converged: NDArray[np.bool_]
    iterations: NDArray[np.intp]

    def shaped(self, lead: tuple[int, ...]) -> _Search:
        return _Search(*(a.reshape(lead) for a in vars(self).values()))

    def replace(self, rows: NDArray[np.intp], other: _Search) -> None:
        for mine, theirs in zip(vars(self).values(), vars(other).values(), strict=True):
            mine[rows] = theirs


def _with_more(problem: _Problem, logs: _Logs, seeds: list[int], criterion: str, tolerance: float) -> _Search:
    """Double the samples of rows (B, S), by a seed each time, until the error is small enough or no seed is left."""
    best = _search(logs, criterion)
    rows = np.arange(len(best.omega))
    for seed in seeds:
        late = best.error[rows] > tolerance
        if not late.any():
            break
        rows, problem, logs = rows[late], problem.at(np.flatnonzero(late)), logs.at(np.flatnonzero(late))
        more = problem.logs(sample(problem.proposal, np.random.default_rng(seed), logs.first.shape[-1]).points)
        logs = _Logs(*(np.concatenate(pair, -1) for pair in zip(logs, more, strict=True)))
        best.replace(rows, _search(logs, criterion))
    return best


def _search(logs: _Logs, criterion: str) -> _Search:
    """Minimise omega * pull + log mean exp(omega contrast + base) over [0, 1], rows (B, S)."""
    contrast, base = logs.first - logs.second, logs.second - logs.proposal
    if criterion == "chernoff":
        naive, pull = np.zeros(contrast.shape), np.zeros(len(contrast))
    else:
        naive = normalised(logs.first + logs.second - logs.proposal)
        pull = -(naive * contrast).sum(-1)  # kappa of (21)

    def derivatives(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        c = contrast[rows]
        share = normalised(w[:, None] * c + base[rows])
        mean = (share * c).sum(-1)
        return pull[rows] + mean, (share * (c - mean[:, None]) ** 2).sum(-1)

    solution = minimise_on_interval(derivatives, len(pull))
    omega = solution.weights
    share = normalised(omega[:, None] * contrast + base)
    mean = (share * contrast).sum(-1)
    centred = contrast - mean[:, None]
    # Each sample's part in the slope: that of a ratio of means in its numerator and denominator.
    part = share * centred - naive * (contrast + pull[:, None])
    curvature = (share * centred**2).sum(-1)
    return _Search(omega, _error(part, pull + mean, curvature), solution.converged, solution.iterations)


def _error(part: Array, slope: Array, curvature: Array) -> Array:
    """Two standard errors of omega (B,) from the samples' parts in the slope (B, S).

    At an end the slope may lead outwards: by that much omega is sure not to come in.
    """
    count = part.shape[-1]
    batches = min(BATCHES, count)
    even = part[:, : count - count % batches].reshape(len(part), count // batches, batches)
    spread = even.sum(1).std(-1, ddof=1) * np.sqrt(batches)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.maximum(STANDARD_ERRORS * spread - np.abs(slope), 0.0) / curvature
    # Densities that differ nowhere have no best exponent, and need none.
    return np.asarray(np.minimum(np.where(spread > 0.0, error, 0.0), 1.0))
