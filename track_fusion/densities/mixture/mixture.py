"""Gaussian mixtures: log-pdf and its derivatives, moments, sampling."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from track_fusion import angles
from track_fusion.densities.log_domain import log_of, log_sum_exp
from track_fusion.linalg import Array, cholesky, matvec, outer, symmetrise, transpose, whitener

LOG_2PI = float(np.log(2.0 * np.pi))
#: Numbers in a temporary: larger ones leave the cache and, worse, are given back to the system each time.
CHUNK = 25600


@dataclasses.dataclass(frozen=True)
class Mixture:
    """A stack of Gaussian mixtures: weight (..., C), mean (..., C, n), cov (..., C, n, n)."""

    weight: Array
    mean: Array
    cov: Array

    @property
    def count(self) -> int:
        """Number of components C."""
        return int(self.weight.shape[-1])

    @property
    def normalised(self) -> Mixture:
        """The same with weights of sum one."""
        return dataclasses.replace(self, weight=self.weight / self.weight.sum(-1, keepdims=True))

    def take(self, index: NDArray[np.intp]) -> Mixture:
        """Pick components (..., P) of each mixture by index."""
        return Mixture(*(take_components(a, index) for a in (self.weight, self.mean, self.cov)))

    def at(self, key: Any) -> Mixture:
        """Index the leading axes of all three arrays alike."""
        return Mixture(self.weight[key], self.mean[key], self.cov[key])

    def broadcast(self, lead: tuple[int, ...]) -> Mixture:
        """Repeat, without copying, to the leading axes `lead`."""
        return Mixture(
            np.broadcast_to(self.weight, (*lead, *self.weight.shape[-1:])),
            np.broadcast_to(self.mean, (*lead, *self.mean.shape[-2:])),
            np.broadcast_to(self.cov, (*lead, *self.cov.shape[-3:])),
        )


def take_components(array: NDArray[Any], index: NDArray[np.intp]) -> NDArray[Any]:
    """Pick components (..., P) of an array (..., C, ...) by index."""
    return np.take_along_axis(array, component_index(array, index), index.ndim - 1)


def component_index(array: NDArray[Any], index: NDArray[np.intp]) -> NDArray[np.intp]:
    """Give an index (..., P) of components as many axes as an array (..., C, ...) has."""
    return index.reshape(*index.shape, *(1,) * (array.ndim - index.ndim))


def gaussian(mean: Array, cov: Array) -> Mixture:
    """Return a Gaussian as a mixture (..., 1), cov (..., n, n) broadcast to mean (..., n)."""
    cov = np.broadcast_to(cov, (*mean.shape, mean.shape[-1]))
    return Mixture(np.ones((*mean.shape[:-1], 1)), mean[..., None, :], cov[..., None, :, :])


def moments(mixture: Mixture, periods: Sequence[float] = ()) -> tuple[Array, Array]:
    """Mean (..., n) and covariance (..., n, n) of each mixture, its weights normalised first.

    `periods` (n,) are those of axes that wrap, see :mod:`track_fusion.angles`; empty: none does.
    """
    return angles.moments(mixture.weight, mixture.mean, mixture.cov, periods)


def log_pdf(mixture: Mixture, points: Array) -> Array:
    """Log-density of each mixture at points (..., S, n), in nats: (..., S).

    Weights are taken as they are: of an un-normalised mixture it is the log-intensity.

    Raises
    ------
    LinAlgError    a covariance is not positive definite

    Notes          Leading axes broadcast. O(S C n^2), worked on in pieces that stay in the cache.
    """
    return Factored.of(mixture).log_pdf(points)


@dataclasses.dataclass(frozen=True)
class Factored:
    """Mixtures whose covariances are factored once, to be evaluated at many points.

    Attributes
    ----------
    log_weight : (..., C)
    mean : (..., C, n)
    white : (..., C, n, n)    W, lower triangular, W P W' = 1
    """

    log_weight: Array
    mean: Array
    white: Array

    @classmethod
    def of(cls, mixture: Mixture) -> Factored:
        """Factor a mixture."""
        return cls(log_of(mixture.weight), mixture.mean, whitener(mixture.cov))

    @property
    def lead(self) -> tuple[int, ...]:
        """Leading axes."""
        return self.mean.shape[:-2]

    @property
    def log_scale(self) -> Array:
        """Log-weight of each component plus its log-density at its mean, (..., C)."""
        n = self.mean.shape[-1]
        half_logdet = np.log(np.diagonal(self.white, axis1=-2, axis2=-1)).sum(-1)
        return np.asarray(self.log_weight + half_logdet - 0.5 * n * LOG_2PI)

    def _rows(self) -> tuple[Array, Array, Array]:
        """Return origin (..., n), the rows of -W m and W with axes first (..., n, C, 1 + n), and the scale."""
        origin = self.mean.mean(-2)
        offset = matvec(self.white, self.mean - origin[..., None, :])
        rows = np.concatenate([-offset[..., None], self.white], -1)
        return origin, np.ascontiguousarray(np.swapaxes(rows, -2, -3)), self.log_scale[..., None]

    def joint(self, points: Array) -> Array:
        """Log of weight times density of each component at points (..., S, n): (..., C, S)."""
        origin, rows, log_scale = self._rows()
        return _joint(_augmented(points, origin), rows, log_scale)

    def log_pdf(self, points: Array) -> Array:
        """Log-density at points (..., S, n): (..., S); see :func:`log_pdf`."""
        lead = np.broadcast_shapes(self.lead, points.shape[:-2])
        size, count = math.prod(lead), points.shape[-2]
        origin, *factors = self._rows()
        x, rows, log_scale = (
            np.broadcast_to(a, (*lead, *a.shape[-k:])).reshape(size, *a.shape[-k:])
            for a, k in zip((_augmented(points, origin), *factors), (2, 3, 2), strict=True)
        )
        values = np.empty((size, count))
        for batch, piece in _pieces(size, count, self.mean.shape[-2]):
            values[batch, piece] = log_sum_exp(_joint(x[batch, :, piece], rows[batch], log_scale[batch]), -2)
        return values.reshape(*lead, count)

    def derivatives(self, points: Array) -> tuple[Array, Array, Array]:
        """Log-density (..., S), its gradient (..., S, n) and its Hessian (..., S, n, n) at points (..., S, n)."""
        n, count = points.shape[-1], self.mean.shape[-2]
        z = self.white @ (transpose(points)[..., None, :, :] - self.mean[..., None])
        joint = self.log_scale[..., None] - 0.5 * (z * z).sum(-2)
        value = log_sum_exp(joint, -2)
        share = np.exp(joint - np.where(np.isfinite(value), value, 0.0)[..., None, :])
        pull = transpose(self.white) @ z  # (..., C, n, S): P^-1 (x - m)
        gradient = -transpose((share[..., None, :] * pull).sum(-3))
        second = ((share[..., None, :] * pull)[..., :, None, :] * pull[..., None, :, :]).sum(-4)
        info = (transpose(self.white) @ self.white).reshape(*self.lead, count, n * n)
        mean_info = (transpose(share) @ info).reshape(*points.shape, n)
        hessian = np.moveaxis(second, -1, -3) - mean_info - outer(gradient)
        return value, gradient, symmetrise(hessian)


def _augmented(points: Array, origin: Array) -> Array:
    """Points about the origin with axes first and a row of ones above them, (..., 1 + n, S)."""
    x = transpose(points - origin[..., None, :])
    whole = np.empty((*x.shape[:-2], x.shape[-2] + 1, x.shape[-1]))
    whole[..., 0, :], whole[..., 1:, :] = 1.0, x
    return whole


def _joint(x: Array, rows: Array, log_scale: Array) -> Array:
    """Log of weight times density (..., C, S), summing the squares of W (x - m) axis by axis.

    Row i of W, lower triangular, needs the first i + 1 axes and the offset alone; temporaries stay small.
    """
    square: Array | None = None
    for i in range(x.shape[-2] - 1):
        z = rows[..., i, :, : i + 2] @ x[..., : i + 2, :]
        z *= z
        square = z if square is None else np.add(square, z, out=square)
    assert square is not None
    square *= -0.5
    square += log_scale
    return square


def _pieces(batch: int, count: int, width: int) -> Iterator[tuple[slice, slice]]:
    """Cut `batch` sets of `count` points, each of `width` numbers, into pieces of about CHUNK numbers."""
    step = max(1, min(count, CHUNK // width))
    sets = max(1, CHUNK // (width * max(count, 1))) if step == count else 1
    for b in range(0, batch, sets):
        for s in range(0, count, max(step, 1)):
            yield slice(b, b + sets), slice(s, s + step)


class Samples(NamedTuple):
    """Points (..., S, n) drawn from mixtures, and the component (..., S) each came from."""

    points: Array
    label: NDArray[np.intp]


def sample(mixture: Mixture, rng: np.random.Generator, count: int) -> Samples:
    """Draw `count` points from each mixture, its weights normalised first.

    Notes    All mixtures of a batch share the same random numbers, so that a mixture's points do not depend
             on the batch around it. Components are chosen systematically: each receives its share to
             within one point.
    """
    lead, n = mixture.mean.shape[:-2], mixture.mean.shape[-1]
    start, normal = rng.random(), rng.normal(size=(count, n))
    position = (start + np.arange(count)) / count
    edges = np.cumsum(mixture.weight, -1)
    edges = edges[..., :-1] / edges[..., -1:]
    label = (edges[..., None, :] <= position[:, None]).sum(-1)
    root = np.take_along_axis(cholesky(mixture.cov), label[..., None, None], -3)
    centre = np.take_along_axis(mixture.mean, label[..., None], -2)
    return Samples(centre + matvec(root, np.broadcast_to(normal, (*lead, count, n))), label)


# Batches of mixtures of different numbers of components.


def chosen(take: NDArray[np.bool_], one: Mixture, other: Mixture) -> Mixture:
    """Take, where `take` (...), the mixture `one`, else `other`; padded to the same number of components."""
    count = max(one.count, other.count)
    one, other = padded(one, count), padded(other, count)
    return Mixture(
        np.where(take[..., None], one.weight, other.weight),
        np.where(take[..., None, None], one.mean, other.mean),
        np.where(take[..., None, None, None], one.cov, other.cov),
    )


def padded(mixture: Mixture, count: int) -> Mixture:
    """Repeat the first component, at weight 0, up to `count` components."""
    at = np.arange(count)
    at = np.where(at < mixture.count, at, 0)
    weight = np.where(np.arange(count) < mixture.count, mixture.weight[..., at], 0.0)
    return Mixture(weight, mixture.mean[..., at, :], mixture.cov[..., at, :, :])


def stacked(*mixtures: Mixture) -> Mixture:
    """Stack K mixtures (..., C_k) as sources (..., K, C), the smaller padded."""
    each = [padded(mixture, max(m.count for m in mixtures)) for mixture in mixtures]
    return Mixture(
        np.stack([m.weight for m in each], -2),
        np.stack([m.mean for m in each], -3),
        np.stack([m.cov for m in each], -4),
    )


def same(one: Mixture, other: Mixture) -> NDArray[np.bool_]:
    """Tell which mixtures (...) are equal, component by component; components of weight 0 do not count."""
    count = max(one.count, other.count)
    one, other = padded(one, count), padded(other, count)
    shape = (one.mean == other.mean).all(-1) & (one.cov == other.cov).all((-2, -1))
    return np.asarray(((one.weight == other.weight) & (shape | (one.weight == 0.0))).all(-1))
