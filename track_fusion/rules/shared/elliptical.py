"""What the rules for elliptical tracks share: the family that the tracks are taken to belong to."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.elliptical.elliptical import Family, gaussian, generalized_gaussian, student_t
from track_fusion.densities.elliptical.projection import nearest_mean
from track_fusion.densities.gaussian import weighted_product
from track_fusion.linalg import Array
from track_fusion.params import Params, param
from track_fusion.rules.base import FusedTracks, SourceTracks, Values
from track_fusion.rules.shared.weights import diagnostics

#: Covariances (B, K, n, n) of the tracks as projected to one mean, (33)-(34) -> fused (B, n, n), converged (B,).
Scatter = Callable[[Array], tuple[Array, NDArray[np.bool_]]]

#: Parameters of examples.
HEAVY_TAILS: Values = {"family": "generalized_gaussian", "beta": 0.7}

FAMILIES = ("student_t", "generalized_gaussian", "gaussian")


def family_param(default: str) -> str:
    """Make the field that chooses the family."""
    field: str = param(
        default,
        "family of all densities: student_t of the least dof among a target's tracks (Gaussian if none is finite), "
        "generalized_gaussian of shape 'beta', or gaussian; every track keeps its mean and covariance",
        choices=FAMILIES,
    )
    return field


@dataclasses.dataclass(frozen=True)
class EllipticalParams(Params):
    """Which family the tracks belong to."""

    family: str = family_param("student_t")
    beta: float = param(
        1.0, "shape of family generalized_gaussian: 1 is Gaussian, smaller has heavier tails", low=0.0, strict=True
    )


@dataclasses.dataclass(frozen=True)
class MhdpParams(EllipticalParams):
    """The family of the tracks, and what the mean minimises."""

    criterion: str = param(
        "squared",
        "what the mean minimises: the sum of the squared projection distances to the tracks, or of the distances (39), "
        "which often makes it one track's estimate",
        choices=("squared", "unsquared"),
    )


def family_of(tracks: SourceTracks, params: EllipticalParams) -> tuple[Family, Array | None]:
    """Return the family common to the tracks of a target, and the dof of a fused track (None: no Student-t).

    The densities must belong to one family, or there is no manifold that holds them all. A track of another dof is
    matched to it by its mean and covariance; the least dof has the heaviest tails, so none is trusted more than it
    says.

    Raises
    ------
    ValueError    beta is given for another family, or too small for the number of axes
    """
    axes = tracks.mean.shape[-1]
    if params.beta != 1.0 and params.family != "generalized_gaussian":
        raise ValueError(f"The 'beta' parameter needs family 'generalized_gaussian'. Got family {params.family!r}.")
    if params.family == "generalized_gaussian":
        return generalized_gaussian(params.beta, axes), None
    if params.family == "gaussian" or tracks.dof is None:
        return gaussian(axes), None
    dof = tracks.dof.min(-1)
    return student_t(dof, axes), dof


def each(tracks: SourceTracks, constant: Array) -> Array:
    """Spread a constant of the family, (...) or for all, over the flat batch, (B,)."""
    return np.broadcast_to(constant, tracks.batch).reshape(-1)


def fuse_projected(tracks: SourceTracks, params: MhdpParams, scatter: Scatter | None) -> FusedTracks:
    """Fuse by MHDP: the mean nearest to all tracks (39), and a covariance made of them as projected to it.

    Parameters
    ----------
    tracks : SourceTracks       mean (..., K, n), cov (..., K, n, n), dof (..., K) or None
    params : MhdpParams
    scatter : Scatter or None   None: the intersection (49)-(50) of the tracks at the weights of the mean

    Returns
    -------
    FusedTracks    as of mhdp_iterative
    """
    (mean, cov), (family, dof) = tracks.flat, family_of(tracks, params)
    # Scatters are covariances over kappa, so distances by covariances take c kappa.
    pull = each(tracks, family.pull * family.kappa)
    nearest = nearest_mean(mean, cov, pull, params.criterion == "squared")
    info = {**diagnostics(nearest), "snapped": nearest.snapped}
    if scatter is None:
        fused_cov = weighted_product(mean, cov, nearest.weights)[1]
    else:
        alpha = 1.0 + 0.5 * pull[:, None] * nearest.distance
        fused_cov, converged = scatter(alpha[..., None, None] * cov)
        info["converged"] = nearest.converged & converged
    fused = tracks.fused(nearest.mean, fused_cov, nearest.weights, info=info)
    return dataclasses.replace(fused, dof=dof)
