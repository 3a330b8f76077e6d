"""What the rules for elliptical tracks share: the family that the tracks are taken to belong to."""

from __future__ import annotations

import dataclasses

import numpy as np

from track_fusion.densities.elliptical.elliptical import Family, gaussian, generalized_gaussian, student_t
from track_fusion.densities.elliptical.projection import ProjectionMean, nearest_mean
from track_fusion.linalg import Array
from track_fusion.params import Params, param
from track_fusion.rules.base import SourceTracks

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


def nearest_mean_of(tracks: SourceTracks, pull: Array, squared: bool) -> ProjectionMean:
    """Minimise projection distances over the batch of the tracks, flattened to (B, K, n).

    `pull` (...) is c of the family: scatters are covariances over kappa, so distances by covariances take c kappa.
    """
    *batch, count, n = tracks.mean.shape
    flat = np.broadcast_to(pull, batch).reshape(-1)
    return nearest_mean(tracks.mean.reshape(-1, count, n), tracks.cov.reshape(-1, count, n, n), flat, squared)


def projected(tracks: SourceTracks, family: Family, squared: bool) -> tuple[ProjectionMean, Array]:
    """Find the MHDP mean (39) and the tracks' covariances as projected to it, (33)-(34): alpha_k P_k, (B, K, n, n)."""
    *_, count, n = tracks.mean.shape
    pull = family.pull * family.kappa
    found = nearest_mean_of(tracks, pull, squared)
    flat = np.broadcast_to(pull, tracks.mean.shape[:-2]).reshape(-1, 1)
    scale = 1.0 + 0.5 * flat * found.distance
    return found, scale[..., None, None] * tracks.cov.reshape(-1, count, n, n)
