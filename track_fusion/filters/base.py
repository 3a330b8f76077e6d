"""What every filter is: parameters alone; all that changes is in its states, and each step returns a new one.

Within a filter axes that wrap are unrolled: motions carry a mean of pi + .1 on as they would one of .1 - pi, and
sensors' residuals are the short way round. Whoever makes a track of a state wraps its mean.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Protocol, TypeVar

import numpy as np

from track_fusion.densities.mixture.mixture import Mixture
from track_fusion.linalg import Array, logdet, mahalanobis_squared

S = TypeVar("S")
#: How the target moves over an interval: a Transition, or one for each mode.
M_contra = TypeVar("M_contra", contravariant=True)
#: What was seen, and the sensor that saw it.
Z_contra = TypeVar("Z_contra", contravariant=True)
H_contra = TypeVar("H_contra", contravariant=True)
#: What an update learns.
I_co = TypeVar("I_co", covariant=True)


class Filter(Protocol[S, M_contra, Z_contra, H_contra, I_co]):
    """Predicts and updates states of one kind, each with any leading axes, such as Monte Carlo runs.

    Unless a filter says otherwise, states are of n axes, (..., n), z is a measurement, (..., m), and leading axes
    broadcast.
    """

    def predict(self, state: S, motion: M_contra, /) -> S:
        """Return the state moved by x' = f(x) + w."""

    def update(self, state: S, z: Z_contra, sensor: H_contra, /) -> tuple[S, I_co]:
        """Return the state conditioned on what a sensor saw, and what was learned from it."""


class Density(Protocol):
    """What is known of a target."""

    @property
    def moments(self) -> tuple[Array, Array]:
        """Mean (..., n) and covariance (..., n, n)."""


class TrackState(Density, Protocol):
    """A state that a track can be made of."""

    @property
    def dof(self) -> Array | float:
        """Degrees of freedom (...)."""

    @property
    def components(self) -> Mixture:
        """The density as a mixture, particles without covariance."""


class TrackFilter(Filter[S, M_contra, Z_contra, H_contra, I_co], Protocol[S, M_contra, Z_contra, H_contra, I_co]):
    """A filter that can start from a Gaussian, and go on from a density that others made."""

    def begin(self, mean: Array, cov: Array) -> S:
        """Return a state of mean (..., n) and covariance (..., n, n), which broadcast; random numbers start anew."""

    def adopt(self, state: S, density: Density) -> S:
        """Return the state with another density, which is brought into the filter's form."""


class Likelihood(Protocol):
    """What most updates learn."""

    @property
    def log_likelihood(self) -> Array:
        """Log-likelihood of what was seen, (...)."""


@dataclasses.dataclass(frozen=True)
class Evidence:
    """What an update learned: the log-likelihood of what was seen, (...)."""

    log_likelihood: Array


@dataclasses.dataclass(frozen=True)
class Innovation:
    """What an update learned: residual (..., m) and its covariance (..., m, m); of them, when asked for, the rest."""

    residual: Array
    cov: Array

    @cached_property
    def nis(self) -> Array:
        """Normalised innovation squared r' S^-1 r, (...)."""
        return mahalanobis_squared(self.residual, self.cov)

    @property
    def log_likelihood(self) -> Array:
        """Log of N(residual; 0, cov)."""
        size = self.residual.shape[-1]
        return np.asarray(-0.5 * (self.nis + logdet(self.cov) + size * np.log(2 * np.pi)))


@dataclasses.dataclass(frozen=True)
class Gaussian:
    """A state of one Gaussian, or of one Student-t density.

    Attributes
    ----------
    mean : (..., n)
    cov : (..., n, n)    always the covariance; it broadcasts: a whole batch may share one, (1, n, n)
    dof : (...)          degrees of freedom; infinite: Gaussian
    """

    mean: Array
    cov: Array
    dof: Array | float = np.inf

    @property
    def moments(self) -> tuple[Array, Array]:
        """Mean (..., n) and covariance (..., n, n)."""
        return self.mean, self.cov

    @property
    def components(self) -> Mixture:
        """The only component, of weight 1."""
        return Mixture(np.ones((*self.mean.shape[:-1], 1)), self.mean[..., None, :], self.cov[..., None, :, :])


class GaussianFilter:
    """What the filters of one Gaussian share: they start from it, and take over the moments of any density."""

    def begin(self, mean: Array, cov: Array) -> Gaussian:
        """Return the Gaussian."""
        return Gaussian(mean, cov)

    def adopt(self, state: Gaussian, density: Density) -> Gaussian:
        """Return the state with the moments of the density; its tails stay."""
        return Gaussian(*density.moments, state.dof)
