"""Whether quotients of Gaussians by a mixture have an integral: proved, refuted by a direction, or undecided.

N(x; m, P) / p_c(x) has one if along every direction v some component t of p_c falls more slowly than the numerator:
max over t of v' (P^-1 - P_t^-1) v > 0. In axes in which P is the unit matrix the smallest value of that over unit
vectors v is the smallest information difference. To find it is not a convex problem.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog, minimize

from track_fusion.densities.mixture.mixture import Mixture
from track_fusion.densities.mixture.proposals import MOST_SPREAD, direct_local_sampling, heavy_tail
from track_fusion.densities.mixture.quotient import Quotient, laplace
from track_fusion.linalg import SMALLEST_PIVOT, Array, cholesky, matvec, transpose, whitener

#: Directions that the search for the smallest information difference starts along.
STARTS = 1000
#: Steps of descent from each, and from how many of the lowest the search ends exactly.
STEPS, POLISHED = 30, 8
#: By so much of the first a step is shorter than the last, so that a descent does not go back and forth.
SHORTER = 0.2
#: Most directions along which a convex combination is made positive before it is given up.
CUTS = 60


class Verdicts(NamedTuple):
    """What is known of the integrals of mixands.

    Attributes
    ----------
    proved : (..., M)           the information difference from one component, or from a convex combination of some,
                                is positive definite
    refuted : (..., M)          there is a direction along which the difference from each is not positive
    direction : (..., M, n)     that direction, of unit length; zero where none is known
    least : (..., M)            where neither is the case, the smallest information difference that was found, which
                                is positive; else infinite
    """

    proved: NDArray[np.bool_]
    refuted: NDArray[np.bool_]
    direction: Array
    least: Array


def integrability(quotient: Quotient, common: Mixture, sure: NDArray[np.bool_]) -> Verdicts:
    """Tell of which mixands of an exact quotient the integral is finite.

    Parameters
    ----------
    quotient : Quotient    (..., M) mixands
    common : Mixture       (..., T) the denominator
    sure : (..., M)        mixands of which it is proved, as `exact_bound` does by one component, or need not be asked

    Returns
    -------
    Verdicts    a mixand of weight zero counts as proved

    Notes    Components alone prove less than their convex combinations: of 56 valid quotients they missed 5. The best
             combination is a semi-definite program, solved by cuts: the directions along which the last one fails. Its
             failure proves nothing but for two components (Yuan's lemma), so that then the smallest
             difference is sought, from STARTS directions.
    """
    proved = np.array(sure | ~np.isfinite(quotient.numerator.log_weight))
    refuted, least = np.zeros(proved.shape, bool), np.full(proved.shape, np.inf)
    direction = np.zeros(quotient.numerator.mean.shape)
    for index in zip(*np.nonzero(~proved), strict=True):
        lower = cholesky(quotient.numerator.cov[index])
        lead = tuple(0 if s == 1 else i for s, i in zip(common.weight.shape[:-1], index[:-1], strict=True))
        image = whitener(common.cov[lead][common.weight[lead] > 0.0]) @ lower
        proved[index], along, value = smallest_difference(np.eye(lower.shape[-1]) - transpose(image) @ image)
        if not proved[index]:
            refuted[index] = value <= SMALLEST_PIVOT
            least[index] = np.inf if refuted[index] else value
            direction[index] = refuted[index] * (lower @ along) / np.linalg.norm(lower @ along)
    return Verdicts(proved, refuted, direction, least)


def smallest_difference(forms: Array) -> tuple[bool, Array, float]:
    """Find the unit vector v (n,) of the smallest max over t of v' A_t v, for forms A_t (T, n, n).

    Returns
    -------
    proved    a convex combination of the forms is positive definite, so that the value is, too; v is then any
    v, value  the lowest found; the search stops at any that is not positive
    """
    proved, vectors = _combined(forms)
    values = _along(forms, vectors).max(1)
    best = int(values.argmin())
    if proved or values[best] <= SMALLEST_PIVOT:
        return proved, vectors[best], float(values[best])
    return False, *_search(forms)


def _along(forms: Array, v: Array) -> Array:
    """V' A_t v for forms (T, n, n) and directions (S, n), (S, T)."""
    return np.asarray(np.einsum("sti,si->st", np.einsum("si,tij->stj", v, forms), v))


def _combined(forms: Array) -> tuple[bool, Array]:
    """Tell whether a positive definite convex combination is found, and along which directions one was made positive.

    The weights that make the least value along the directions known so far largest are those of a linear program.
    """
    count = len(forms)
    scaled = forms / np.maximum(np.linalg.norm(forms, axis=(1, 2)), 1.0)[:, None, None]  # the answer is the same
    vectors = transpose(np.linalg.eigh(scaled)[1]).reshape(-1, forms.shape[-1])
    for _ in range(CUTS):
        cuts = _along(scaled, vectors)
        best = linprog(
            np.r_[np.zeros(count), -1.0], np.c_[-cuts, np.ones(len(cuts))], np.zeros(len(cuts)),
            np.r_[np.ones(count), 0.0][None], [1.0], [(0.0, None)] * count + [(None, None)],
        )  # fmt: skip
        if best.x is None or best.x[-1] <= SMALLEST_PIVOT:
            return False, vectors
        values, axes = np.linalg.eigh(np.einsum("t,tij->ij", best.x[:-1], scaled))
        if values[0] > SMALLEST_PIVOT:
            return True, vectors
        vectors = np.concatenate([vectors, transpose(axes)[values <= best.x[-1] / 2.0]])
    return False, vectors


def _search(forms: Array) -> tuple[Array, float]:
    """Minimise the largest of v' A_t v over unit vectors v from STARTS directions: descent, then exactly."""
    v = np.random.default_rng(0).normal(size=(STARTS, forms.shape[-1]))
    size = np.maximum(np.linalg.norm(forms, axis=(1, 2)), 1.0)
    for step in range(STEPS + 1):
        v /= np.linalg.norm(v, axis=1, keepdims=True)
        values = _along(forms, v)
        value, top = values.max(1), values.argmax(1)
        if value.min() <= SMALLEST_PIVOT or step == STEPS:
            break
        slope = matvec(forms[top], v) - value[:, None] * v
        v = v - slope / ((1.0 + SHORTER * step) * size[top])[:, None]
    order = np.argsort(value)
    ends = [(v[order[0]], float(value[order[0]]))]
    if ends[0][1] > SMALLEST_PIVOT:
        ends += [_polished(forms, start) for start in v[order[:POLISHED]]]
    return min(ends, key=lambda end: end[1])


def _polished(forms: Array, start: Array) -> tuple[Array, float]:
    """End a descent from v (n,) where the largest forms are equal: the least s >= v' A_t v for all t, |v| = 1."""
    n, one = len(start), np.ones((len(forms), 1))

    def level(y: Array) -> float:
        return float(y[n])

    def slope(y: Array) -> Array:
        return np.asarray(np.r_[np.zeros(n), 1.0])

    constraints: Any = [
        {"type": "ineq", "fun": lambda y: y[n] - y[:n] @ forms @ y[:n],
         "jac": lambda y: np.concatenate([-2.0 * forms @ y[:n], one], 1)},
        {"type": "eq", "fun": lambda y: y[:n] @ y[:n] - 1.0, "jac": lambda y: np.r_[2.0 * y[:n], 0.0]},
    ]  # fmt: skip
    end = minimize(
        level, np.r_[start, _along(forms, start[None]).max()], jac=slope,
        method="SLSQP", constraints=constraints, options={"maxiter": 100, "ftol": 1e-12},
    )  # fmt: skip
    v = np.asarray(end.x[:n] / np.linalg.norm(end.x[:n]), np.float64)
    return v, float(_along(forms, v[None]).max())


# What is undecided.

#: Samples that are to show whether an undecided mixand has an integral, and the least share of them to be effective.
CHECKS, EFFECTIVE = 1000, 0.01


def effective_share(quotient: Quotient, asked: NDArray[np.bool_], rng: np.random.Generator) -> Array:
    """Share of samples, drawn from heavy tails, that are effective for the mixands asked for, (..., M); else 1.

    Where a few samples have all the weight, as those far out have if there is no integral, next to none are.
    """
    share = np.ones(asked.shape)
    order = np.argsort(~asked, axis=-1, kind="stable")[..., : int(asked.sum(-1).max(initial=0))]
    if order.shape[-1]:
        some = quotient.take(order)
        near = laplace(some)
        drawn = direct_local_sampling(some, heavy_tail(near, MOST_SPREAD * near.cov), rng, CHECKS)
        np.put_along_axis(share, order, drawn.ess / CHECKS, -1)
    return np.where(asked, share, 1.0)
