"""Probabilistic data association (PDA) with existence: a track updated in clutter by all detections in its gate."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from track_fusion.filters.base import Gaussian
from track_fusion.filters.extended import Extended
from track_fusion.filters.interacting_multiple_model import reweighted
from track_fusion.filters.kalman import joseph, linear_gain
from track_fusion.linalg import Array, logdet, matvec, outer, solve, symmetrise, transpose
from track_fusion.models.base import Sensor, Transition
from track_fusion.params import Params, param
from track_fusion.solvers.chi_square import chi_square_quantile


@dataclasses.dataclass(frozen=True)
class ClutterParams(Params):
    """What a sensor misses and invents."""

    detection_probability: float = param(0.9, "probability that a target in view is detected", low=0.0, high=1.0)
    gate_probability: float = param(0.99, "probability that a target's detection lies in its gate", low=0.0, high=1.0)
    clutter_density: float = param(
        1e-6, "false detections per unit of measurement space and scan (m rad for range and bearing)", low=0.0,
        strict=True,
    )  # fmt: skip
    survival_probability: float = param(0.99, "probability that a target is still there at the next scan", low=0.0,
                                        high=1.0)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Association:
    """What an update learned.

    Attributes
    ----------
    weight : (..., D + 1)    probability that none (the last), or each detection, is the target's
    gated : (..., D) bool    which detections lie in the gate
    log_ratio : (...)        log-likelihood ratio of the scan: target there against not there
    """

    weight: Array
    gated: NDArray[np.bool_]
    log_ratio: Array


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A target that may be there.

    Attributes
    ----------
    mean : (..., n)
    cov : (..., n, n)
    existence : (...)    probability that it is
    """

    mean: Array
    cov: Array
    existence: Array

    @property
    def moments(self) -> tuple[Array, Array]:
        """Mean (..., n) and covariance (..., n, n) of the target, if it is there."""
        return self.mean, self.cov


class Scan(NamedTuple):
    """Detections (..., D, m), each track may have its own; which are there, (..., D): padding is not; D may be 0."""

    values: Array
    present: NDArray[np.bool_]


C = TypeVar("C", bound=Candidate)


@dataclasses.dataclass(frozen=True)
class ProbabilisticDataAssociation:
    """The PDA filter on models linearised at the mean.

    References    Y. Bar-Shalom, F. Daum, J. Huang, The probabilistic data association filter, 2009; Sharma 6.4; for
                  the existence D. Musicki, R. Evans, S. Stankovic, Integrated probabilistic data association, 1994.
    """

    params: ClutterParams = ClutterParams()

    def predict(self, state: C, transition: Transition) -> C:
        """Predict by one scan; a target may vanish."""
        moved = Extended().predict(Gaussian(state.mean, state.cov), transition)
        existence = state.existence * self.params.survival_probability
        return dataclasses.replace(state, mean=moved.mean, cov=moved.cov, existence=existence)

    def update(self, state: C, scan: Scan, sensor: Sensor) -> tuple[C, Association]:
        """Condition on a scan of which at most one detection is the target's, the rest clutter.

        Notes    Clutter is Poisson, uniform in the gate. The posterior mixture of D + 1 Gaussians is merged; but for
                 that and the linearisation it is exact. Another target's detections count as clutter, so targets
                 must be farther apart than their gates.
        """
        mean, cov, params = state.mean, state.cov, self.params
        slope, size = sensor.jacobian(mean), sensor.noise.shape[-1]
        residual = sensor.residual(scan.values, sensor.observe(mean)[..., None, :])
        gain, spread = linear_gain(cov, slope, sensor.noise)
        distance = (residual * transpose(solve(spread, transpose(residual)))).sum(-1)
        gated = scan.present & (distance <= chi_square_quantile(params.gate_probability, size))
        weight, log_ratio = _weights(distance, gated, logdet(spread), size, params)
        part = weight[..., :-1, None]
        shift = (part * residual).sum(-2)
        missed = weight[..., -1, None, None]
        scatter = transpose(part * residual) @ residual - outer(shift)
        mixed = missed * cov + (1.0 - missed) * joseph(cov, gain, slope, sensor.noise)
        posterior = symmetrise(mixed + gain @ scatter @ transpose(gain))
        existence = update_existence(state.existence, log_ratio)
        updated = dataclasses.replace(state, mean=mean + matvec(gain, shift), cov=posterior, existence=existence)
        return updated, Association(weight, gated, log_ratio)

    def missed(self, state: C) -> C:
        """Update by a scan without a detection in the gate, which leaves mean and covariance as they are."""
        return dataclasses.replace(state, existence=update_existence(state.existence, np.array(_missed(self.params))))


def _weights(
    distance: Array, gated: NDArray[np.bool_], log_det: Array, size: int, params: ClutterParams
) -> tuple[Array, Array]:
    """Association probabilities (..., D + 1) and the log of what they were divided by (...)."""
    with np.errstate(divide="ignore"):
        scale = np.log(params.detection_probability) - np.log(params.clutter_density)
    density = -0.5 * (distance + log_det[..., None] + size * np.log(2.0 * np.pi))
    log_weight = np.where(gated, scale + density, -np.inf)
    none = np.full((*log_weight.shape[:-1], 1), _missed(params))
    return reweighted(np.ones(1), np.concatenate([log_weight, none], -1))


def _missed(params: ClutterParams) -> float:
    """Log-likelihood ratio of a scan without a detection in the gate."""
    with np.errstate(divide="ignore"):
        return float(np.log1p(-params.detection_probability * params.gate_probability))


def update_existence(existence: Array, log_ratio: Array) -> Array:
    """Existence probability (...) after a scan of this log-likelihood ratio, target there against not there."""
    ratio = np.exp(np.minimum(log_ratio, 700.0))
    return np.asarray(existence * ratio / (1.0 - existence + existence * ratio))
