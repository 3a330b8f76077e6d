"""Axes that wrap: differences, moments and interpolation on the circle.

An axis has a period: 2 pi for a direction, pi for one whose sign is unknown, infinite for all that does not wrap.
States are told RELATIVE to a reference, one of them: differences lie in [-period/2, period/2) and are numbers like any
other, as long as the states lie within half a period (:func:`within_half_circle`). What is computed of them is put
back onto the reference. So turning everything by an angle turns the result by that angle, to the last digits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from track_fusion import linalg
from track_fusion.linalg import Array, logdet, merged_moments

#: Period of a direction, radians.
TURN = 2.0 * np.pi
#: Period of a direction whose sign is unknown, such as the long axis of a box.
HALF_TURN = np.pi
#: Periods of the axes whose names say that they wrap; those of other axes are given by who names them.
KNOWN_PERIODS: Mapping[str, float] = dict.fromkeys(
    ("yaw", "heading", "course", "roll", "pitch", "bearing", "azimuth", "elevation"), TURN
)
#: What a user writes behind the name of a direction whose sign is unknown.
SIGN_UNKNOWN = ":pi"
#: States this close to opposite, in the unit of the axis, have no mean direction: rounding would decide.
OPPOSITE = 1e-6


def periods_of(axes: Sequence[str], wraps: Mapping[str, float] | None = None) -> tuple[float, ...]:
    """Return the period of each axis: as given in `wraps`, else as its name says, else infinite.

    Parameters
    ----------
    axes : n names
    wraps : periods by name    unit of the axis, > 0; infinite for a known name that shall not wrap

    Raises
    ------
    ValueError    a name in `wraps` is no axis
    """
    wraps = wraps or {}
    unknown = [name for name in wraps if name not in axes]
    if unknown:
        raise ValueError(f"The angular axis '{unknown[0]}' is none of the axes {', '.join(axes)}.")
    return tuple(float(wraps.get(a, KNOWN_PERIODS.get(a, np.inf))) for a in axes)


def named_period(spelt: str) -> tuple[str, float]:
    """Read an angular axis as users spell it: `psi` wraps after a turn, `psi:pi`, its sign unknown, after half a turn.

    Returns
    -------
    name, period
    """
    name = spelt.removesuffix(SIGN_UNKNOWN)
    return name, TURN if name == spelt else HALF_TURN


def wraps(periods: Any) -> bool:
    """Tell whether any axis wraps; quickly, since most states have none that does."""
    return math.isfinite(periods) if isinstance(periods, (float, int)) else any(map(math.isfinite, periods))


def wrap(values: ArrayLike, periods: ArrayLike) -> Array:
    """Bring values (...), or (..., n), to [-period/2, period/2); those that lie there stay, to the last digit.

    `periods` is one number, or (n,). Without a value to bring the array itself is returned.
    """
    values = np.asarray(values, np.float64)
    if not wraps(periods):
        return values
    periods = np.asarray(periods, np.float64)
    outside = np.isfinite(periods) & ((values < -0.5 * periods) | (values >= 0.5 * periods))
    if not outside.any():
        return values
    period = np.broadcast_to(periods, outside.shape)[outside]
    wrapped = np.array(np.broadcast_to(values, outside.shape))
    turned = (wrapped[outside] + 0.5 * period) % period - 0.5 * period
    # The remainder of a tiny negative number is the period itself.
    wrapped[outside] = np.where(turned < 0.5 * period, turned, -0.5 * period)
    return wrapped


def difference(a: ArrayLike, b: ArrayLike, periods: ArrayLike) -> Array:
    """Return a - b, (..., n), the short way round: in [-period/2, period/2)."""
    return wrap(np.subtract(a, b), periods)


def shifted(reference: ArrayLike, shift: ArrayLike, periods: ArrayLike) -> Array:
    """Return reference + shift, (..., n), wrapped: what undoes :func:`difference`."""
    return wrap(np.add(reference, shift), periods)


def heaviest(weight: Array, mean: Array) -> Array:
    """Return the mean of the largest weight, (..., K), (..., K, n) -> (..., n); of equal ones the first."""
    at = np.argmax(weight, -1)[..., None, None]
    return np.asarray(np.take_along_axis(mean, at, -2)[..., 0, :])


def center(weight: Array, mean: Array, periods: ArrayLike) -> Array:
    """Return what weighted states are told relative to, (..., K), (..., K, n), (n,) -> (..., n).

    In axes that wrap it is the direction of the sum of their unit vectors, which a wide cloud has, too; in the others,
    and where the vectors cancel, that of the heaviest.
    """
    wrapping = np.isfinite(periods)
    phase = np.where(wrapping, TURN / np.asarray(periods, np.float64), 0.0)
    total = np.einsum("...k,...kn->...n", weight, np.exp(1j * phase * mean))
    clear = wrapping & (np.abs(total) > OPPOSITE * weight.sum(-1)[..., None])
    return np.where(clear, np.angle(total) / np.where(wrapping, phase, 1.0), heaviest(weight, mean))


def most_certain(mean: Array, cov: Array) -> Array:
    """Return the mean of the least determinant, (..., K, n), (..., K, n, n) -> (..., n); of equal ones the first.

    Raises
    ------
    LinAlgError    a covariance is not positive definite
    """
    return heaviest(-logdet(cov), mean)


def within_half_circle(relative: Array, periods: ArrayLike) -> NDArray[np.bool_]:
    """Tell whether states have a mean direction: their spread is below half a period, less 1e-6, in every axis.

    Parameters
    ----------
    relative : (..., K, n)    differences to one of the K
    periods : (n,)

    Returns
    -------
    (...) bool
    """
    spread = relative.max(-2) - relative.min(-2)
    return np.asarray((spread < 0.5 * np.asarray(periods) - OPPOSITE).all(-1))


def moments(weight: Array, mean: Array, cov: Array, periods: ArrayLike) -> tuple[Array, Array]:
    """Merge weighted components into mean and covariance, relative to their :func:`center`.

    Parameters
    ----------
    weight : (..., C)       non-negative, not all zero; need not sum to 1
    mean : (..., C, n)
    cov : (..., C, n, n)
    periods : (n,), or empty: no axis wraps

    Returns
    -------
    mean (..., n) wrapped, cov (..., n, n)

    Notes     Beyond a half circle another reference gives another result.
    """
    weight = weight / weight.sum(-1, keepdims=True)
    if not wraps(periods):
        return merged_moments(mean, cov, weight)
    reference = center(weight, mean, periods)
    shift, merged = merged_moments(difference(mean, reference[..., None, :], periods), cov, weight)
    return shifted(reference, shift, periods), merged


def sample_moments(weight: Array, points: Array, periods: ArrayLike) -> tuple[Array, Array]:
    """Mean (..., n), wrapped, and covariance (..., n, n) of weighted samples, as :func:`moments` of such components.

    Shapes (..., S), sum one, (..., S, n), and (n,), or empty: no axis wraps.
    """
    if not wraps(periods):
        return linalg.sample_moments(weight, points)
    reference = center(weight, points, periods)
    shift, cov = linalg.sample_moments(weight, difference(points, reference[..., None, :], periods))
    return shifted(reference, shift, periods), cov


def interpolate(start: Array, end: Array, share: Array, periods: ArrayLike) -> Array:
    """Return the state at a share of the short way from `start` to `end`: (..., n), (..., n), (...) -> (..., n)."""
    return shifted(start, np.asarray(share)[..., None] * difference(end, start, periods), periods)
