"""The data model: a batch of tracks as a frozen struct of arrays."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from track_fusion import angles
from track_fusion.layouts import StateLayout as StateLayout
from track_fusion.layouts import planar_layout as planar_layout
from track_fusion.linalg import (
    ASYMMETRY_TOLERANCE,
    Array,
    is_positive_definite,
    is_well_conditioned,
    symmetrise,
    transpose,
)

#: Times are integers of nanoseconds.
SECOND_NS = 1_000_000_000

# Bits of `status`.
CONFIRMED = 1
COASTED = 2  # no source supported the track at its time
SELF_REPORTED = 4  # the publisher says that this track is its own state

UUID_BYTES = 16
#: A state value beyond this, or a standard deviation beyond it, is a fault of the sender: the
#: squares and inverses of such numbers no longer fit double precision.
ABSURD = 1e12
#: How far the weights of a normalised mixture may sum from one.
WEIGHT_TOLERANCE = 1e-6


@dataclasses.dataclass(frozen=True, eq=False)
class TrackBatch:
    """N tracks of C mixture components each, valid at their times, in one frame and layout.

    Attributes
    ----------
    layout : StateLayout          n axes
    frame_id : str                frame of every state
    weight : (N, C)               mixture weights; padded with 0
    mean : (N, C, n)              SI units
    cov : (N, C, n, n)            always the covariance, whatever `dof`; zero for particles
    time_ns : (N,) int64          time for which the state is valid
    track_id : (N,) int64         unique in the batch (0 to 2^32 - 1, what the wire carries)
    source : (N,) uint32          provenance: bit k is the centre's k-th configured source
    status : (N,) uint8           bits CONFIRMED, COASTED, SELF_REPORTED
    existence : (N,)              existence probability
    dof : (N,)                    degrees of freedom, inf = Gaussian, else > 2
    uuid : (N, 16) uint8 or None  identity across publishers and restarts
    phd : bool                    an un-normalised mixture: weights need not sum to 1

    Construction checks every array and raises ValueError; :meth:`screened` drops and counts bad
    tracks instead.
    """

    layout: StateLayout
    frame_id: str
    weight: Array
    mean: Array
    cov: Array
    time_ns: NDArray[np.int64]
    track_id: NDArray[np.int64]
    source: NDArray[np.uint32]
    status: NDArray[np.uint8]
    existence: Array
    dof: Array
    uuid: NDArray[np.uint8] | None = None
    phd: bool = False

    def __post_init__(self) -> None:
        _coerce(self)
        for reason, bad in _faults(self).items():
            if bad.any():
                first = int(np.flatnonzero(bad)[0])
                raise ValueError(_explain(self, reason, first, int(bad.sum())))
        _symmetrise(self)

    def __len__(self) -> int:
        """Return the number of tracks N."""
        return len(self.mean)

    @property
    def components(self) -> int:
        """Number of components C (padded)."""
        return int(self.mean.shape[1])

    @property
    def is_confirmed(self) -> NDArray[np.bool_]:
        """Which tracks are confirmed, (N,)."""
        return (self.status & CONFIRMED) > 0

    @property
    def is_coasted(self) -> NDArray[np.bool_]:
        """Which tracks no source supported at their time, (N,)."""
        return (self.status & COASTED) > 0

    @property
    def faults(self) -> tuple[str, ...]:
        """Reasons for which some track is bad; :meth:`replace` does not check what it takes."""
        return tuple(reason for reason, bad in _faults(self).items() if bad.any())

    @property
    def sound(self) -> NDArray[np.bool_]:
        """Tell which tracks are densities that a reader takes, (N,), whatever their identifiers."""
        good = np.ones(len(self), bool)
        if not len(good) or _is_density(self):
            return good
        for bad in _faults(self.replace(track_id=np.arange(len(self)))).values():
            good &= ~bad
        return good

    @classmethod
    def empty(cls, layout: StateLayout, frame_id: str) -> TrackBatch:
        """Make a batch of no tracks."""
        return cls.gaussian(layout, frame_id, np.zeros((0, layout.size)), np.zeros((0, layout.size, layout.size)))

    @classmethod
    def gaussian(
        cls, layout: StateLayout, frame_id: str, mean: Any, cov: Any, *, time_ns: Any = 0, track_id: Any = None,
        source: Any = 0, status: Any = CONFIRMED, existence: Any = 1.0, dof: Any = np.inf,
    ) -> TrackBatch:  # fmt: skip
        """Make a batch of single-component tracks from mean (N, n) and cov (N, n, n)."""
        mean, cov = np.asarray(mean, float), np.asarray(cov, float)
        n = len(mean)
        return cls(
            layout, frame_id, np.ones((n, 1)), mean[:, None], cov[:, None],
            np.broadcast_to(np.asarray(time_ns, np.int64), n),
            np.arange(n) if track_id is None else np.asarray(track_id),
            np.broadcast_to(np.asarray(source, np.uint32), n), np.broadcast_to(np.asarray(status, np.uint8), n),
            np.broadcast_to(np.asarray(existence, float), n), np.broadcast_to(np.asarray(dof, float), n),
        )  # fmt: skip

    @classmethod
    def screened(cls, **arrays: Any) -> tuple[TrackBatch, Counter[str]]:
        """Build a batch from arrays of the same names, leaving out and counting bad tracks by reason.

        Raises
        ------
        ValueError    the shapes do not fit each other (there is no telling which track is bad)
        TypeError     an array is missing or unknown
        """
        fields = dataclasses.fields(cls)
        wrong = [f.name for f in fields if f.default is dataclasses.MISSING and f.name not in arrays]
        wrong += arrays.keys() - {f.name for f in fields}
        if wrong:
            raise TypeError(f"The array '{wrong[0]}' of a batch is {'unknown' if wrong[0] in arrays else 'missing'}.")
        batch = object.__new__(cls)
        vars(batch).update({"uuid": None, "phd": False} | arrays)
        _coerce(batch)
        rejected: Counter[str] = Counter()
        good = np.ones(len(batch), bool)
        for reason, bad in _faults(batch).items():
            rejected[reason] = int((bad & good).sum())
            good &= ~bad
        _symmetrise(batch)
        return (batch if good.all() else batch[good]), +rejected

    def replace(self, **fields: Any) -> TrackBatch:
        """Return a batch with some arrays exchanged for computed ones of the same N; not checked again."""
        batch = object.__new__(TrackBatch)
        own = vars(batch)
        own.update(vars(self))
        own.update(fields)
        if "cov" in fields:
            own.pop("well_conditioned", None)
        if "cov" in fields or "mean" in fields or "weight" in fields:
            own.pop("moments", None)
        return batch

    def owned(self) -> TrackBatch:
        """Return the batch in arrays that nobody can write to: copies, where somebody could."""
        batch = self.replace()
        for name in ROW_FIELDS if self.uuid is None else (*ROW_FIELDS, "uuid"):
            array = getattr(self, name)
            flags = array.flags
            if flags.writeable or not flags.owndata:
                vars(batch)[name] = array = array.copy()
                array.setflags(write=False)
        return batch

    def __getitem__(self, index: Any) -> TrackBatch:
        """Select tracks by a mask, an index array or a slice."""
        rows = {f: getattr(self, f)[index] for f in ROW_FIELDS}
        return self.replace(**rows, uuid=None if self.uuid is None else self.uuid[index])

    @staticmethod
    def concatenate(batches: Sequence[TrackBatch]) -> TrackBatch:
        """Join batches of one layout and frame, padding components with weight 0.

        Raises
        ------
        ValueError    no batch, or layouts, frames or kinds differ
        """
        if not batches:
            raise ValueError("The 'batches' parameter must hold at least one batch. Got none.")
        first = batches[0]
        for b in batches:
            if (b.layout, b.frame_id, b.phd) != (first.layout, first.frame_id, first.phd):
                raise ValueError(
                    "Batches must share layout, frame and kind. "
                    f"Got {first.layout.axes} in '{first.frame_id}' and {b.layout.axes} in '{b.frame_id}'."
                )
        count = max(b.components for b in batches)
        padded = [b._padded(count) for b in batches]
        rows = {f: np.concatenate([getattr(b, f) for b in padded]) for f in ROW_FIELDS}
        uuid = None
        if any(b.uuid is not None for b in batches):
            blank = [np.zeros((len(b), UUID_BYTES), np.uint8) if b.uuid is None else b.uuid for b in batches]
            uuid = np.concatenate(blank)
        return first.replace(**rows, uuid=uuid)

    def _padded(self, count: int) -> TrackBatch:
        extra = count - self.components
        if extra == 0:
            return self
        # A padded component repeats the first, so that its covariance stays valid; its weight is 0.
        fill = {f: np.concatenate([getattr(self, f)] + [getattr(self, f)[:, :1]] * extra, 1) for f in ("mean", "cov")}
        weight = np.concatenate([self.weight, np.zeros((len(self), extra))], 1)
        return self.replace(weight=weight, **fill)

    def to_axes(self, layout: StateLayout) -> TrackBatch:
        """Reorder or marginalise to the axes of another layout; an axis may wrap there that did not, or sooner.

        Raises
        ------
        ValueError    an axis is missing, or its period no multiple of the other layout's
        """
        if layout == self.layout:
            return self
        at = np.array(self.layout.into(layout))
        mean = angles.wrap(self.mean[..., at], layout.periods)
        return self.replace(layout=layout, mean=mean, cov=self.cov[..., at[:, None], at])

    @cached_property
    def moments(self) -> tuple[Array, Array]:
        """Mean (N, n) and covariance (N, n, n) of each track, its mixture merged."""
        if self.components == 1:
            return self.mean[:, 0], self.cov[:, 0]
        return angles.moments(self.weight, self.mean, self.cov, self.layout.periods)

    @cached_property
    def well_conditioned(self) -> NDArray[np.bool_]:
        """Which components have a covariance definite by more than rounding, (N, C)."""
        return is_well_conditioned(self.cov)


#: The arrays that have a row a track, besides uuid.
ROW_FIELDS = ("weight", "mean", "cov", "time_ns", "track_id", "source", "status", "existence", "dof")
_DTYPES = {"weight": np.float64, "mean": np.float64, "cov": np.float64, "time_ns": np.int64, "track_id": np.int64,
           "source": np.uint32, "status": np.uint8, "existence": np.float64, "dof": np.float64}  # fmt: skip


def _coerce(batch: TrackBatch) -> None:
    """Give every array its type and check that the shapes fit each other."""
    for name, dtype in _DTYPES.items():
        object.__setattr__(batch, name, np.asarray(getattr(batch, name), dtype))
    if batch.mean.ndim != 3 or batch.mean.shape[1] < 1:
        raise ValueError(f"The 'mean' of a batch must have shape (N, C >= 1, n). Got {batch.mean.shape}.")
    n, c, size = batch.mean.shape
    if size != batch.layout.size:
        raise ValueError(f"The 'mean' must have {batch.layout.size} axes, {batch.layout.axes}. Got {size}.")
    shapes = dict.fromkeys(ROW_FIELDS, (n,)) | {"weight": (n, c), "mean": (n, c, size), "cov": (n, c, size, size)}
    for name, shape in shapes.items():
        if getattr(batch, name).shape != shape:
            raise ValueError(f"The '{name}' of a batch must have shape {shape}. Got {getattr(batch, name).shape}.")
    if batch.uuid is not None:
        object.__setattr__(batch, "uuid", np.asarray(batch.uuid, np.uint8))
        if batch.uuid.shape != (n, UUID_BYTES):
            raise ValueError(f"The 'uuid' of a batch must have shape {(n, UUID_BYTES)}. Got {batch.uuid.shape}.")


def _symmetrise(batch: TrackBatch) -> None:
    """Take rounding noise out of the covariances."""
    cov = symmetrise(batch.cov)
    if (cov != batch.cov).any():
        object.__setattr__(batch, "cov", cov)
        vars(batch).pop("well_conditioned", None)


def _faults(batch: TrackBatch) -> dict[str, NDArray[np.bool_]]:
    """Tell by reason which tracks are bad, in the order in which reasons are reported."""
    if _is_clean(batch):
        return {}
    none = np.zeros(len(batch), bool)
    finite = np.asarray(np.isfinite(batch.mean).all((1, 2)) & np.isfinite(batch.cov).all((1, 2, 3)))
    safe = batch.cov if finite.all() else np.where(finite[:, None, None, None], batch.cov, np.eye(batch.layout.size))
    size = np.abs(safe).max((1, 2, 3), initial=0.0)
    with np.errstate(invalid="ignore"):
        huge = (np.abs(batch.mean).max((1, 2), initial=0.0) > ABSURD) | (size > ABSURD**2)
        weight_ok = np.isfinite(batch.weight).all(1) & (batch.weight >= 0).all(1) & (batch.weight.sum(1) > 0)
        if not batch.phd:
            weight_ok &= np.abs(batch.weight.sum(1) - 1.0) <= WEIGHT_TOLERANCE
        existence_ok = (batch.existence >= 0) & (batch.existence <= 1)
        dof_ok = batch.dof > 2
    asymmetric = np.abs(safe - transpose(safe)).max((1, 2, 3), initial=0.0) > ASYMMETRY_TOLERANCE * size
    return {
        "not_finite": ~finite,
        "absurd_value": finite & huge,
        "asymmetric_covariance": asymmetric,
        "not_positive_definite": ~_definite(batch, safe, size),
        "bad_weight": ~weight_ok,
        "bad_existence": ~existence_ok,
        "bad_dof": ~dof_ok,
        "bad_track_id": (batch.track_id < 0) | (batch.track_id > 0xFFFFFFFF),
        "duplicate_track_id": _repeated(batch.track_id) if len(batch) > 1 else none,
    }


def _is_clean(batch: TrackBatch) -> bool:
    """Tell quickly that no track is bad; false when a track may be (it is looked at closely then)."""
    ids = batch.track_id
    if not len(ids):
        return True
    unique = ids.min() >= 0 and ids.max() <= 0xFFFFFFFF and (len(ids) == 1 or len(np.unique(ids)) == len(ids))
    return bool(unique and _is_density(batch))


def _is_density(batch: TrackBatch) -> bool:
    """Tell quickly that every track, one at least, is a density, whatever its identifier; false when one may not be."""
    mean, cov, weight = batch.mean, batch.cov, batch.weight
    # Comparisons are false for NaN, so that these refuse it as well.
    if not (mean.max() <= ABSURD and mean.min() >= -ABSURD and cov.max() <= ABSURD**2 and cov.min() >= -(ABSURD**2)):
        return False
    total, existence = weight.sum(1), batch.existence
    return bool(
        (total.min() > 0 if batch.phd else np.abs(total - 1.0).max() <= WEIGHT_TOLERANCE)
        and weight.min() >= 0
        and existence.min() >= 0
        and existence.max() <= 1
        and batch.dof.min() > 2
        and (cov == transpose(cov)).all()
        and (batch.well_conditioned.all() if cov.any() else (weight > 0).sum(1).min() > 1)
    )


def _definite(batch: TrackBatch, cov: Array, size: Array) -> NDArray[np.bool_]:
    """Positive definite throughout, or a particle track: several components, all without covariance."""
    good = (size == 0) & ((batch.weight > 0).sum(1) > 1)
    rest = np.flatnonzero(~good)
    good[rest] = is_positive_definite(symmetrise(cov[rest])).all(1)
    return np.asarray(good)


def _repeated(ids: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell which entries repeat an earlier one."""
    _, first = np.unique(ids, return_index=True)
    again = np.ones(len(ids), bool)
    again[first] = False
    return again


def _explain(batch: TrackBatch, reason: str, row: int, count: int) -> str:
    field = {"not_finite": "mean' or 'cov", "absurd_value": "mean' or 'cov", "asymmetric_covariance": "cov",
             "not_positive_definite": "cov", "bad_weight": "weight", "bad_existence": "existence", "bad_dof": "dof",
             "bad_track_id": "track_id", "duplicate_track_id": "track_id"}[reason]  # fmt: skip
    wanted = {
        "not_finite": "be finite", "absurd_value": f"not exceed {ABSURD:g} (cov: its square)",
        "asymmetric_covariance": "be symmetric", "not_positive_definite": "be positive definite",
        "bad_weight": "be non-negative and sum to 1", "bad_existence": "lie between 0 and 1", "bad_dof": "exceed 2",
        "bad_track_id": "fit 32 bits without sign", "duplicate_track_id": "be unique",
    }[reason]  # fmt: skip
    got = ""
    if reason == "not_positive_definite":
        got = f" Smallest eigenvalue: {np.linalg.eigvalsh(symmetrise(batch.cov[row])).min():.3g}."
    elif "'" not in field and field != "cov":
        got = f" Got {getattr(batch, field)[row]}."
    return f"The '{field}' of a track must {wanted}: track {batch.track_id[row]} ({count} in all).{got}"
