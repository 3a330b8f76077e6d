"""The interacting multiple model filter with a Gaussian sum in each mode: for states far from Gaussian."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from track_fusion.densities.mixture.mixture import Mixture, moments
from track_fusion.densities.mixture.reduction import runnalls
from track_fusion.filters.base import Evidence, Gaussian
from track_fusion.filters.extended import Extended
from track_fusion.filters.interacting_multiple_model import GaussianModeFilter, check_chain, mixing, reweighted
from track_fusion.linalg import Array
from track_fusion.models.base import Sensor, Transition

#: (mixture (..., C), count) -> mixture of at most `count` components: those of densities/mixture/reduction.py
Reduce = Callable[[Mixture, int], Mixture]


@dataclasses.dataclass(frozen=True)
class MixtureModes:
    """A Gaussian mixture of C components for each of M modes.

    Attributes
    ----------
    probability : (..., M)    sum one
    mixture : Mixture         weight (..., M, C), sum one in each mode, mean (..., M, C, n), cov (..., M, C, n, n)
    """

    probability: Array
    mixture: Mixture

    @property
    def marginal(self) -> Mixture:
        """The mixture of all modes, M C components."""
        (*lead, modes, count), n = self.mixture.weight.shape, self.mixture.mean.shape[-1]
        return Mixture(
            (self.probability[..., None] * self.mixture.weight).reshape(*lead, modes * count),
            self.mixture.mean.reshape(*lead, modes * count, n),
            self.mixture.cov.reshape(*lead, modes * count, n, n),
        )

    @property
    def moments(self) -> tuple[Array, Array]:
        """Mean (..., n) and covariance (..., n, n) over all modes and components."""
        return moments(self.marginal)


def mix(modes: MixtureModes, chain: Array) -> MixtureModes:
    """Let the modes jump: each new mode's mixture holds the components of all old ones, M C of them.

    Parameters
    ----------
    modes : MixtureModes    (..., M)
    chain : (M, M)          chain[i, j] = probability of going from mode i to mode j

    Raises
    ------
    ValueError    the chain is malformed
    """
    part, count = modes.mixture, modes.probability.shape[-1]
    check_chain(chain, count)
    (*lead, _, size), n = part.weight.shape, part.mean.shape[-1]
    following, share = mixing(modes.probability, chain)
    weight = (share[..., None] * part.weight[..., None, :, :]).reshape(*lead, count, count * size)
    mean = np.broadcast_to(part.mean.reshape(*lead, 1, count * size, n), (*weight.shape, n))
    cov = np.broadcast_to(part.cov.reshape(*lead, 1, count * size, n, n), (*weight.shape, n, n))
    return MixtureModes(following, Mixture(weight, mean, cov))


@dataclasses.dataclass(frozen=True, eq=False)
class GaussianSumModes:
    """The IMM with Gaussian sums.

    Attributes
    ----------
    chain : (M, M)       chain[i, j] = probability of going from mode i to mode j
    count : int          components to keep in each mode
    reduce : Reduce      Runnalls, as in Ahmed
    jump_first : bool    false: move by the old mode, then jump (Ahmed (57), (73)); true: jump, then move
    one : Filter         of a component

    Notes         Exact, but for the linearisation, as long as nothing is reduced: C grows M-fold at each step.
    References    Ahmed (67)-(73) and 5.4.2.
    """

    chain: Array
    count: int
    reduce: Reduce = runnalls
    jump_first: bool = False
    one: GaussianModeFilter = Extended()

    def predict(self, modes: MixtureModes, transitions: Sequence[Transition]) -> MixtureModes:
        """Predict one interval, each of the M modes by its transition, then reduce each to at most `count` components.

        Raises
        ------
        ValueError    the chain is malformed
        """
        modes = mix(modes, self.chain) if self.jump_first else modes
        part = modes.mixture
        moved = [
            self.one.predict(Gaussian(part.mean[..., i, :, :], part.cov[..., i, :, :, :]), transition)
            for i, transition in enumerate(transitions)
        ]
        mean, cov = np.stack([g.mean for g in moved], -3), np.stack([g.cov for g in moved], -4)
        modes = MixtureModes(modes.probability, Mixture(part.weight, mean, cov))
        modes = modes if self.jump_first else mix(modes, self.chain)
        if modes.mixture.count <= self.count:
            return modes
        return MixtureModes(modes.probability, self.reduce(modes.mixture, self.count))

    def update(self, modes: MixtureModes, z: Array, sensor: Sensor) -> tuple[MixtureModes, Evidence]:
        """Condition every component on z = h(x) + v, (..., m), and weigh components and modes by their likelihoods.

        The evidence is that over all modes.
        """
        part = modes.mixture
        moved, learned = self.one.update(Gaussian(part.mean, part.cov), z[..., None, None, :], sensor)
        weight, mode_likelihood = reweighted(part.weight, learned.log_likelihood)
        probability, total = reweighted(modes.probability, mode_likelihood)
        return MixtureModes(probability, Mixture(weight, moved.mean, moved.cov)), Evidence(total)
