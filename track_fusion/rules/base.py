"""What a fusion rule takes, gives and says of itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np

from track_fusion.linalg import Array
from track_fusion.params import Params

Family = Literal["gaussian", "elliptical", "mixture"]
Arity = Literal["n_ary", "pairwise"]
#: conservative: for every admissible cross-correlation, at weights that do not depend on the means;
#: structural: only under the correlation structure it assumes; exact: what it needs is given.
Guarantee = Literal["conservative", "structural", "exact", "none"]


@dataclasses.dataclass(frozen=True)
class Mixture:
    """A stack of Gaussian mixtures: weight (..., C), mean (..., C, n), cov (..., C, n, n)."""

    weight: Array
    mean: Array
    cov: Array


@dataclasses.dataclass(frozen=True)
class SourceTracks:
    """K tracks of one target, one a source, batched over leading axes; common frame and time, SI units.

    Attributes
    ----------
    mean : (..., K, n)
    cov : (..., K, n, n)       symmetric positive definite: the covariance, whatever `dof`
    dof : (..., K) or None     degrees of freedom of Student-t tracks; None = all Gaussian
    mixture : Mixture or None  weight (..., K, C), mean (..., K, C, n), cov (..., K, C, n, n);
                               `mean` and `cov` are then its merged moments
    extras : mapping           what a rule needs beyond the tracks, under the names in its `needs`
    """

    mean: Array
    cov: Array
    dof: Array | None = None
    mixture: Mixture | None = None
    extras: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def count(self) -> int:
        """Number of sources K."""
        return int(self.mean.shape[-2])


@dataclasses.dataclass(frozen=True)
class FusedTracks:
    """The fused tracks: mean (..., n), cov (..., n, n), and how they came about.

    Attributes
    ----------
    weights : (..., K) or None     fusion weights (omega)
    dof : (...) or None            None = Gaussian
    mixture : Mixture or None      the fused mixture, when the rule keeps one
    info : mapping                 arrays of diagnostics: `converged`, `iterations`, ...
    """

    mean: Array
    cov: Array
    weights: Array | None = None
    dof: Array | None = None
    mixture: Mixture | None = None
    info: Mapping[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Rule:
    """The descriptor from which ROS parameters, the rules table and the contract tests are made."""

    key: str
    title: str
    fuse: Callable[[SourceTracks, Any], FusedTracks]
    params: type[Params]
    family: Family
    arity: Arity
    guarantee: Guarantee
    caveat: str  # when the guarantee holds, or what breaks it
    source: str  # paper and equation numbers
    cost: str  # operations a fusion, in K sources of n axes
    order_matters: bool = False
    needs: tuple[str, ...] = ()  # names of `extras`
    affine_equivariant: bool | str = True  # a string says why not, or under which parameters


def check_weights(weights: tuple[float, ...], count: int, total: float = 1.0) -> Array:
    """Return given fusion weights as an array, or say what is wrong with them.

    Raises
    ------
    ValueError    not one weight a source, a negative one, or a sum other than `total`
    """
    array = np.asarray(weights, float)
    if array.shape != (count,):
        raise ValueError(f"The 'weights' parameter must hold one weight a source, {count}. Got {len(weights)}.")
    if (array < 0).any() or abs(array.sum() - total) > 1e-9:
        raise ValueError(f"The 'weights' parameter must be non-negative and sum to {total:g}. Got {weights}.")
    return array


def check_tracks(tracks: SourceTracks) -> None:
    """Check shapes and finiteness of what a rule is given.

    Raises
    ------
    ValueError    a shape does not fit, no source, or a value is not finite
    """
    mean, cov = tracks.mean, tracks.cov
    if mean.ndim < 2 or mean.shape[-2] < 1 or mean.shape[-1] < 1:
        raise ValueError(f"The 'mean' of source tracks must have shape (..., K >= 1, n >= 1). Got {mean.shape}.")
    if cov.shape != (*mean.shape, mean.shape[-1]):
        raise ValueError(
            f"The 'cov' of source tracks must have shape {(*mean.shape, mean.shape[-1])}. Got {cov.shape}."
        )
    if not (np.isfinite(mean).all() and np.isfinite(cov).all()):
        raise ValueError("The 'mean' and 'cov' of source tracks must be finite.")
