"""Probabilistic data association (PDA) with existence: a track updated in clutter by all detections in its gate."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from track_fusion.filters.interacting_multiple_model import reweighted
from track_fusion.linalg import Array, logdet, matvec, outer, solve, symmetrise, transpose
from track_fusion.models.base import Sensor
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


def update(
    mean: Array, cov: Array, zs: Array, present: NDArray[np.bool_], sensor: Sensor, params: ClutterParams
) -> tuple[Array, Array, Association]:
    """Condition on a scan of which at most one detection is the target's, the rest clutter.

    Parameters
    ----------
    mean : (..., n)
    cov : (..., n, n)
    zs : (..., D, m)             detections; each track may have its own candidates
    present : (..., D) bool      which of them are there (padding is not); D may be 0
    sensor : Sensor              linearised at the mean
    params : ClutterParams

    Returns
    -------
    mean (..., n), cov (..., n, n), Association

    Notes         Clutter is Poisson, uniform in the gate. The posterior mixture of D + 1 Gaussians is merged; but for
                  that and the linearisation it is exact. Another target's detections count as clutter, so targets
                  must be farther apart than their gates.
    References    Y. Bar-Shalom, F. Daum, J. Huang, The probabilistic data association filter, 2009; Sharma 6.4.
    """
    slope, size = sensor.jacobian(mean), sensor.noise.shape[-1]
    residual = sensor.residual(zs, sensor.observe(mean)[..., None, :])
    spread = symmetrise(slope @ cov @ transpose(slope) + sensor.noise)
    gain = transpose(solve(spread, slope @ cov))
    distance = (residual * transpose(solve(spread, transpose(residual)))).sum(-1)
    gated = present & (distance <= chi_square_quantile(params.gate_probability, size))
    weight, log_ratio = _weights(distance, gated, logdet(spread), size, params)
    part = weight[..., :-1, None]
    shift = (part * residual).sum(-2)
    keep = np.eye(mean.shape[-1]) - gain @ slope
    sharpened = keep @ cov @ transpose(keep) + gain @ sensor.noise @ transpose(gain)
    missed = weight[..., -1, None, None]
    scatter = transpose(part * residual) @ residual - outer(shift)
    posterior = missed * cov + (1.0 - missed) * sharpened + gain @ scatter @ transpose(gain)
    return mean + matvec(gain, shift), symmetrise(posterior), Association(weight, gated, log_ratio)


def _weights(
    distance: Array, gated: NDArray[np.bool_], log_det: Array, size: int, params: ClutterParams
) -> tuple[Array, Array]:
    """Association probabilities (..., D + 1) and the log of what they were divided by (...)."""
    with np.errstate(divide="ignore"):
        scale = np.log(params.detection_probability) - np.log(params.clutter_density)
    density = -0.5 * (distance + log_det[..., None] + size * np.log(2.0 * np.pi))
    log_weight = np.where(gated, scale + density, -np.inf)
    none = np.full((*log_weight.shape[:-1], 1), missed_log_ratio(params))
    return reweighted(np.ones(1), np.concatenate([log_weight, none], -1))


def missed_log_ratio(params: ClutterParams) -> float:
    """Log-likelihood ratio of a scan without a detection in the gate: such a scan leaves mean and cov as they are."""
    with np.errstate(divide="ignore"):
        return float(np.log1p(-params.detection_probability * params.gate_probability))


def predict_existence(existence: Array, params: ClutterParams) -> Array:
    """Existence probability (...) one scan later."""
    return np.asarray(existence * params.survival_probability)


def update_existence(existence: Array, log_ratio: Array) -> Array:
    """Existence probability (...) after a scan.

    References    D. Musicki, R. Evans, S. Stankovic, Integrated probabilistic data association, 1994.
    """
    ratio = np.exp(np.minimum(log_ratio, 700.0))
    return np.asarray(existence * ratio / (1.0 - existence + existence * ratio))
