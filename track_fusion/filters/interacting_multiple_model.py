"""The interacting multiple model filter (IMM): a target that jumps between any number of motions."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from track_fusion.densities.log_domain import log_of, log_sum_exp, normalised
from track_fusion.filters.base import Evidence, Filter, Gaussian, Likelihood
from track_fusion.filters.extended import Extended
from track_fusion.linalg import Array, merged_moments
from track_fusion.models.base import Sensor, Transition


@dataclasses.dataclass(frozen=True)
class Modes:
    """A Gaussian for each of M modes.

    Attributes
    ----------
    probability : (..., M)    sum one
    mean : (..., M, n)
    cov : (..., M, n, n)
    """

    probability: Array
    mean: Array
    cov: Array

    @classmethod
    def start(cls, probability: Array, mean: Array, cov: Array) -> Modes:
        """Give every mode the same Gaussian, mean (..., n), cov (..., n, n); probability (M,) or (..., M)."""
        count, lead = probability.shape[-1], mean.shape[:-1]
        return cls(
            np.broadcast_to(probability, (*lead, count)).copy(),
            np.repeat(mean[..., None, :], count, -2),
            np.repeat(cov[..., None, :, :], count, -3),
        )

    @property
    def moments(self) -> tuple[Array, Array]:
        """Mean (..., n) and covariance (..., n, n) over all modes."""
        return merged_moments(self.mean, self.cov, self.probability)


def check_chain(chain: Array, count: int) -> None:
    """Check a Markov chain's matrix.

    Raises
    ------
    ValueError    it is not (M, M), has a negative entry, or a row that does not sum to one
    """
    if chain.shape != (count, count):
        raise ValueError(f"The 'chain' of {count} modes must have shape {(count, count)}. Got {chain.shape}.")
    if (chain < 0).any() or (np.abs(chain.sum(-1) - 1.0) > 1e-9).any():
        raise ValueError(f"The rows of 'chain' must be non-negative and sum to 1. Got sums {chain.sum(-1)}.")


def mixing(probability: Array, chain: Array) -> tuple[Array, Array]:
    """Return the next modes' probabilities (..., M) and the share (..., j, i) of old mode i in new mode j."""
    joint = np.swapaxes(probability[..., :, None] * chain, -1, -2)
    following = joint.sum(-1)
    empty = following == 0.0
    share = np.where(empty[..., None], probability[..., None, :], joint / np.where(empty, 1.0, following)[..., None])
    return following, share


def mix(modes: Modes, chain: Array) -> Modes:
    """Let the modes jump: each new mode's Gaussian has the moments of the mixture of old ones that lead to it.

    Parameters
    ----------
    modes : Modes      (..., M)
    chain : (M, M)     chain[i, j] = probability of going from mode i to mode j
    """
    count = modes.probability.shape[-1]
    check_chain(chain, count)
    following, share = mixing(modes.probability, chain)
    mean = np.broadcast_to(modes.mean[..., None, :, :], (*share.shape, modes.mean.shape[-1]))
    cov = np.broadcast_to(modes.cov[..., None, :, :, :], (*mean.shape, modes.mean.shape[-1]))
    return Modes(following, *merged_moments(mean, cov, share))


def reweighted(weight: Array, log_likelihood: Array) -> tuple[Array, Array]:
    """Multiply weights (..., M) by likelihoods: the new weights, sum one, and the log of what they summed to."""
    joint = log_of(weight) + log_likelihood
    return normalised(joint), log_sum_exp(joint)


#: The filter within a mode.
GaussianModeFilter = Filter[Gaussian, Transition, Array, Sensor, Likelihood]


@dataclasses.dataclass(frozen=True, eq=False)
class InteractingMultipleModel:
    """The IMM.

    Attributes
    ----------
    chain : (M, M)       chain[i, j] = probability of going from mode i to mode j
    jump_first : bool    true: the mode jumps, then the target moves by the new one (Blom and Bar-Shalom);
                         false: it moves by the old mode, then jumps (Ahmed (57), (73))
    one : Filter         within a mode

    References    H. A. P. Blom, Y. Bar-Shalom, The interacting multiple model algorithm, 1988; Ahmed (67)-(73),
                  where (71) is the probability of m_k and (73) must be divided by P(m_(k+1)).
    """

    chain: Array
    jump_first: bool = True
    one: GaussianModeFilter = Extended()

    def predict(self, modes: Modes, transitions: Sequence[Transition]) -> Modes:
        """Predict one interval, each of the M modes by its transition.

        Raises
        ------
        ValueError    the chain is malformed
        """
        modes = mix(modes, self.chain) if self.jump_first else modes
        moved = [
            self.one.predict(Gaussian(modes.mean[..., i, :], modes.cov[..., i, :, :]), transition)
            for i, transition in enumerate(transitions)
        ]
        modes = Modes(modes.probability, np.stack([g.mean for g in moved], -2), np.stack([g.cov for g in moved], -3))
        return modes if self.jump_first else mix(modes, self.chain)

    def update(self, modes: Modes, z: Array, sensor: Sensor) -> tuple[Modes, Evidence]:
        """Condition every mode on z = h(x) + v, (..., m), and weigh it by its likelihood; evidence over all modes."""
        part, learned = self.one.update(Gaussian(modes.mean, modes.cov), z[..., None, :], sensor)
        probability, total = reweighted(modes.probability, learned.log_likelihood)
        return Modes(probability, part.mean, part.cov), Evidence(total)
