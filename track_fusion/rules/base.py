"""What a fusion rule takes, gives and says of itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from track_fusion import angles
from track_fusion.densities.mixture.mixture import Mixture as Mixture
from track_fusion.densities.mixture.mixture import gaussian, moments
from track_fusion.linalg import Array, asymmetric, is_positive_definite, symmetrise
from track_fusion.params import Params

Family = Literal["gaussian", "elliptical", "mixture"]
Arity = Literal["n_ary", "pairwise"]
#: conservative: for every admissible cross-correlation, at weights that do not depend on the means;
#: structural: only under the correlation structure it assumes; exact: what it needs is given.
Guarantee = Literal["conservative", "structural", "exact", "none"]


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
    extras : mapping           what a rule needs beyond the tracks, under the names in its `needs`; densities among
                               them, a Mixture or several, are in the tracks' axes
    periods : (n,)             of axes that wrap, infinite for the others; empty: none wraps
    """

    mean: Array
    cov: Array
    dof: Array | None = None
    mixture: Mixture | None = None
    extras: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    periods: Sequence[float] = ()

    @classmethod
    def of(cls, densities: Mixture, periods: Sequence[float] = (), **extras: Any) -> SourceTracks:
        """Make tracks of K mixtures (..., K, C); those of one component are Gaussian tracks."""
        mixture = densities if densities.count > 1 else None
        return cls(*moments(densities, periods), mixture=mixture, extras=extras, periods=periods)

    def relative_to(self, reference: Array) -> SourceTracks:
        """Tell the tracks, and the densities among the extras, relative to states (..., n): no axis wraps any more.

        Components stay around the mean of their track, also where that lies half a circle away.
        """
        mean = angles.difference(self.mean, reference[..., None, :], self.periods)

        def around(densities: Mixture, old: Array, new: Array) -> Mixture:
            gap = angles.difference(densities.mean, old[..., None, :], self.periods)
            return dataclasses.replace(densities, mean=new[..., None, :] + gap)

        def extra(value: Any) -> Any:
            if isinstance(value, Mixture):
                return around(value.broadcast(self.batch), reference, np.zeros_like(reference))
            several = isinstance(value, Sequence) and not isinstance(value, str)
            return [extra(one) for one in value] if several else value

        mixture = self.mixture and around(self.mixture, self.mean, mean)
        extras = {name: extra(value) for name, value in self.extras.items()}
        return SourceTracks(mean, self.cov, self.dof, mixture, extras)

    @property
    def count(self) -> int:
        """Number of sources K."""
        return int(self.mean.shape[-2])

    @property
    def batch(self) -> tuple[int, ...]:
        """The leading axes."""
        return self.mean.shape[:-2]

    @property
    def flat(self) -> tuple[Array, Array]:
        """Mean (B, K, n) and cov (B, K, n, n), the leading axes as one."""
        if self.mean.ndim <= 3:
            return (self.mean, self.cov) if self.mean.ndim == 3 else (self.mean[None], self.cov[None])
        tail = self.cov.shape[-3:]
        return self.mean.reshape(-1, *tail[:2]), self.cov.reshape(-1, *tail)

    def fused(
        self,
        mean: Array,
        cov: Array,
        weights: Array | None = None,
        mixture: Mixture | None = None,
        info: Mapping[str, NDArray[Any]] | None = None,
    ) -> FusedTracks:
        """Return what the flat batch (B, ...) was fused to, with the leading axes of these tracks."""
        batch = self.batch

        def shape(array: NDArray[Any]) -> NDArray[Any]:
            if len(batch) == 1:
                return array
            return array.reshape(batch + array.shape[1:]) if batch else array[0, ...]

        return FusedTracks(
            shape(mean),
            shape(cov),
            None if weights is None else shape(weights),
            mixture=mixture and Mixture(*map(shape, vars(mixture).values())),
            info={name: shape(array) for name, array in info.items()} if info else {},
        )


@dataclasses.dataclass(frozen=True)
class FusedTracks:
    """The fused tracks: mean (..., n), cov (..., n, n), and how they came about.

    Attributes
    ----------
    weights : (..., K) or None     fusion weights (omega)
    dof : (...) or None            None = Gaussian
    mixture : Mixture or None      the fused mixture, when the rule keeps one
    info : mapping                 arrays of diagnostics: `converged`, `iterations`, ...; where axes wrap, also
                                   `beyond_half_circle` (...): the tracks had no mean direction and were fused about the
                                   most certain one
    """

    mean: Array
    cov: Array
    weights: Array | None = None
    dof: Array | None = None
    mixture: Mixture | None = None
    info: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def density(self) -> Mixture:
        """The fused mixture, or the Gaussian of the moments, of one component."""
        return gaussian(self.mean, self.cov) if self.mixture is None else self.mixture

    def put_back(self, reference: Array, periods: Sequence[float]) -> FusedTracks:
        """Undo :meth:`SourceTracks.relative_to`: add the states (..., n), and wrap."""
        mixture = self.mixture
        if mixture is not None:
            mean = angles.shifted(reference[..., None, :], mixture.mean, periods)
            mixture = dataclasses.replace(mixture, mean=mean)
        return dataclasses.replace(self, mean=angles.shifted(reference, self.mean, periods), mixture=mixture)


Values = Mapping[str, Any]
#: Stands in an example for one weight a source, unequal and of sum 1.
EACH: Any = ...


@dataclasses.dataclass(frozen=True)
class Example:
    """What the laws of `contract` need to know beyond the descriptor: at which parameters a rule is tried, and how."""

    params: tuple[Values, ...] = ({},)
    not_equivariant: tuple[Values, ...] = ()  # where the result depends on axes and units, if the claim is a text
    ordered: tuple[Values, ...] = ()  # where the order of the sources matters, if the claim is a text
    idempotent: bool | None = None  # whether copies of one track fuse to that track; None: not stated
    keeps_one: bool = True  # whether one track alone comes back as it is
    #: by how many standard deviations moments may vary with the random numbers, if every sample is effective; where
    #: parameters name a number of samples
    monte_carlo: float = 0.0
    #: tracks -> extras that the rule needs and that `contract.EXTRAS` does not know; they must move with the tracks
    extras: Callable[[SourceTracks], Mapping[str, Any]] | None = None
    #: for guarantee none or structural: the true error variance over the claimed one, measured and as stated
    counter_example: Callable[[], tuple[float, float]] | None = None


@dataclasses.dataclass(frozen=True)
class Rule:
    """The descriptor from which ROS parameters, the rules table and the contract tests are made."""

    key: str
    title: str
    fuse: Callable[[SourceTracks, Any], FusedTracks]
    params: type[Params]
    family: Family
    arity: Arity
    guarantee: Guarantee | Callable[[Any], Guarantee]  # at any parameters, or a function of them
    caveat: str  # when the guarantee holds, or what breaks it
    source: str  # paper and equation numbers
    cost: str  # operations a fusion, in K sources of n axes
    order_matters: bool | str = False  # a string says when
    needs: tuple[str, ...] = ()  # names of `extras`
    #: (extra, parameter, value): needed as well when the parameter has this value, and of no use otherwise
    needs_when: tuple[tuple[str, str, str], ...] = ()
    optional: tuple[str, ...] = ()  # names of `extras` that are used when given
    #: (extra, parameter, value): an optional extra that is used only when the parameter has this value
    optional_when: tuple[tuple[str, str, str], ...] = ()
    affine_equivariant: bool | str = True  # a string says why not, or under which parameters
    takes_particles: bool = False  # components without covariance; the fusion centre gives other rules their Gaussian
    takes_phds: bool = False  # mixtures whose weights sum to a number of targets, averaged; other rules normalise them
    linear: bool = False  # the fused mean is linear in the means; all else depends on the covariances alone
    example: Example = Example()

    def __call__(self, tracks: SourceTracks, params: Params | None = None) -> FusedTracks:
        """Check the tracks, then :meth:`apply` the rule.

        Raises
        ------
        ValueError    the tracks are malformed, or lack what the rule needs
        """
        check_tracks(tracks)
        params = self.params() if params is None else params
        missing = [name for name in self.needed(params) if name not in tracks.extras]
        if missing:
            raise ValueError(f"The rule '{self.key}' needs '{missing[0]}' beside the tracks. Got none.")
        return self.apply(tracks, params)

    def apply(self, tracks: SourceTracks, params: Params) -> FusedTracks:
        """Fuse tracks that were screened before; `fuse` itself knows nothing of axes that wrap.

        Where some wrap, it is given the tracks relative to the most certain of them, and what it returns is put back.

        Raises
        ------
        LinAlgError    a covariance is not positive definite
        """
        if not angles.wraps(tracks.periods):
            return self.fuse(tracks, params)
        reference = angles.most_certain(tracks.mean, tracks.cov)
        flat = tracks.relative_to(reference)
        fused = self.fuse(flat, params).put_back(reference, tracks.periods)
        beyond = ~angles.within_half_circle(flat.mean, tracks.periods)
        return dataclasses.replace(fused, info={**fused.info, "beyond_half_circle": beyond})

    def guarantee_at(self, params: Params | None = None) -> Guarantee:
        """Return what is guaranteed at these parameters; None: at their defaults."""
        if not callable(self.guarantee):
            return self.guarantee
        return self.guarantee(self.params() if params is None else params)

    @property
    def promise(self) -> str:
        """What is guaranteed, in words."""
        return f"{self.guarantee_at()} by default" if callable(self.guarantee) else self.guarantee

    def uses(self, extra: str, params: Params) -> bool:
        """Tell whether an optional extra makes a difference at these parameters."""
        values = [getattr(params, key) == value for name, key, value in self.optional_when if name == extra]
        return extra in self.optional and (any(values) or not values)

    def needed(self, params: Params) -> tuple[str, ...]:
        """Names of the extras without which the rule cannot do at these parameters."""
        return (*self.needs, *(name for name, key, value in self.needs_when if getattr(params, key) == value))


def check_tracks(tracks: SourceTracks) -> None:
    """Check what a rule is given: shapes, finiteness, definiteness.

    Raises
    ------
    ValueError    a shape does not fit, no source, a value is not finite, a covariance not symmetric or
                  not positive definite, dof not above 2, a weight of a mixture negative, a period not positive
    """
    mean, cov = tracks.mean, tracks.cov
    if mean.ndim < 2 or mean.shape[-2] < 1 or mean.shape[-1] < 1:
        raise ValueError(f"The 'mean' of source tracks must have shape (..., K >= 1, n >= 1). Got {mean.shape}.")
    _check_shape("cov", cov, (*mean.shape, mean.shape[-1]))
    _check_finite("mean", mean)
    _check_finite("cov", cov)
    if asymmetric(cov):
        raise ValueError("The 'cov' of source tracks must be symmetric.")
    good = is_positive_definite(cov)
    if not good.all():
        lowest = np.linalg.eigvalsh(symmetrise(cov[~good])).min()
        raise ValueError(
            f"The 'cov' of source tracks must be positive definite: {(~good).sum()} of {good.size} are not. "
            f"Smallest eigenvalue: {lowest:.3g}."
        )
    if tracks.periods and (len(tracks.periods) != mean.shape[-1] or not all(p > 0 for p in tracks.periods)):
        raise ValueError(
            f"The 'periods' of source tracks must be {mean.shape[-1]} numbers > 0, infinite where an axis does not "
            f"wrap. Got {tuple(tracks.periods)}."
        )
    if tracks.dof is not None:
        _check_shape("dof", tracks.dof, mean.shape[:-1])
        if not (tracks.dof > 2).all():
            raise ValueError(f"The 'dof' of source tracks must exceed 2. Got {np.min(tracks.dof)}.")
    if tracks.mixture is not None:
        _check_mixture(tracks.mixture, mean.shape)


def _check_mixture(mixture: Mixture, shape: tuple[int, ...]) -> None:
    *batch, n = shape
    part = mixture.weight.shape[-1:]
    _check_shape("mixture.weight", mixture.weight, (*batch, *part))
    _check_shape("mixture.mean", mixture.mean, (*batch, *part, n))
    _check_shape("mixture.cov", mixture.cov, (*batch, *part, n, n))
    for name in ("weight", "mean", "cov"):
        _check_finite(f"mixture.{name}", getattr(mixture, name))
    if asymmetric(mixture.cov):
        raise ValueError("The 'mixture.cov' of source tracks must be symmetric.")
    if (mixture.weight < 0).any():
        raise ValueError(f"The 'mixture.weight' of source tracks must be non-negative. Got {mixture.weight.min()}.")


def _check_shape(name: str, value: Array, shape: tuple[int, ...]) -> None:
    if value.shape != shape:
        raise ValueError(f"The '{name}' of source tracks must have shape {shape}. Got {value.shape}.")


def _check_finite(name: str, value: Array) -> None:
    if not np.isfinite(value).all():
        raise ValueError(f"The '{name}' of source tracks must be finite.")
