"""Tracks as JSON: read what `track-fusion fuse` takes, write what it gives. Every error names its field."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NoReturn

import numpy as np

from track_fusion.linalg import ASYMMETRY_TOLERANCE, Array, is_positive_definite, outer, symmetrise
from track_fusion.params import nearest
from track_fusion.rules import FusedTracks, Mixture, SourceTracks
from track_fusion.tracks import ABSURD, WEIGHT_TOLERANCE

#: What may stand beside "tracks", and in a track besides its density; only where the rule needs it.
SHARED_EXTRAS = ("common", "cross_cov", "target", "seed")
TRACK_EXTRAS = ("independent_cov", "likelihood")
DENSITY = ("mean", "cov", "components")
#: How far below zero, beside the largest, an eigenvalue of a semi-definite matrix may be by rounding.
ROUNDING = 1e-9


class InputError(ValueError):
    """The input is wrong; the message begins with the field."""


@dataclasses.dataclass(frozen=True)
class _Density:
    """Moments (n), (n, n), and the components (C), (C, n), (C, n, n) that they are of."""

    mean: Array
    cov: Array
    parts: Mixture

    @property
    def size(self) -> int:
        return len(self.mean)


def read_tracks(text: bytes, needs: Iterable[str], rule: str, optional: Iterable[str] = ()) -> SourceTracks:
    """Read the tracks that a rule is to fuse.

    Parameters
    ----------
    text : JSON    {"tracks": [track, ...]} and what the rule needs of SHARED_EXTRAS; a track is
                   {"mean": n numbers, "cov": n x n} or {"components": [{"weight", "mean", "cov"}, ...]}, with "dof"
                   ("cov" is the covariance all the same; absent or null: Gaussian) and what the rule needs of
                   TRACK_EXTRAS
    needs          names of the extras that the rule needs: the others are refused, but for the
    optional       ones
    rule           its key, for messages

    Returns
    -------
    SourceTracks    of one fusion: mean (K, n), cov (K, n, n), and `extras` as arrays: independent_cov (K, n, n),
                    likelihood (K,), cross_cov (K, K, n, n) whose diagonal blocks are the tracks' own covariances,
                    common and target as Mixture of (C,), (C, n), (C, n, n) (a Gaussian has one component), seed int

    Raises
    ------
    InputError    a field is missing, unknown, not needed, of a wrong form, or holds a wrong value
    """
    needs, optional = tuple(needs), tuple(optional)
    data = _object(_parse(text), "standard input")
    _check_names(data, "", ("tracks",), (), SHARED_EXTRAS, needs, rule, optional)
    entries = _list(data["tracks"], "tracks", "a list of tracks")
    size: int | None = None
    densities, dofs = [], []
    for k, entry in enumerate(entries):
        path = f"tracks[{k}]"
        track = _object(entry, path)
        _check_names(track, f"{path}.", (), (*DENSITY, "dof"), TRACK_EXTRAS, needs, rule, optional)
        densities.append(_density(track, path, size))
        size = densities[0].size
        dofs.append(_dof(track.get("dof"), f"{path}.dof"))
    cov = np.stack([d.cov for d in densities])
    given = {n for n in TRACK_EXTRAS if n in needs or (n in optional and all(n in e for e in entries))}
    given |= {n for n in SHARED_EXTRAS if n in data}
    extras: dict[str, Any] = {n: _TRACK_READERS[n](entries, densities) for n in TRACK_EXTRAS if n in given}
    extras |= {n: _SHARED_READERS[n](data[n], n, densities) for n in SHARED_EXTRAS if n in given}
    return SourceTracks(
        np.stack([d.mean for d in densities]),
        cov,
        np.array(dofs) if np.isfinite(dofs).any() else None,
        _stacked([d.parts for d in densities]) if any("components" in t for t in entries) else None,
        extras,
    )


def write_fused(fused: FusedTracks) -> dict[str, Any]:
    """Describe the fused track: mean, cov, dof (None: Gaussian), weights, info, components (None: no mixture).

    Raises
    ------
    ValueError    the fused state is not finite
    """
    if not (np.isfinite(fused.mean).all() and np.isfinite(fused.cov).all()):
        raise ValueError("The fused mean or covariance is not finite: the tracks are too extreme for this rule.")
    dof = None if fused.dof is None else float(fused.dof)
    components = None
    if fused.mixture is not None:
        rows = zip(fused.mixture.weight, fused.mixture.mean, fused.mixture.cov, strict=True)
        # Weight 0 only pads tracks of fewer components.
        components = [{"weight": w, "mean": m, "cov": c} for w, m, c in rows if w > 0]
    return {
        "mean": fused.mean,
        "cov": fused.cov,
        "dof": dof,
        "weights": fused.weights,
        "info": fused.info,
        "components": components,
    }


# The form of the input.


def _fail(path: str, text: str) -> NoReturn:
    raise InputError(f"{path}: {text}")


def _shown(value: Any) -> str:
    """Write a value that was found, at most some words of it."""
    try:
        text = json.dumps(value)
    except (TypeError, ValueError, RecursionError):
        text = type(value).__name__
    return text if len(text) <= 60 else text[:57] + "..."


def _parse(text: bytes) -> Any:
    if not text.strip():
        _fail("standard input", 'is empty; it must hold {"tracks": [{"mean": [...], "cov": [[...]]}, ...]}')
    try:
        return json.loads(text, object_pairs_hook=_without_repeats)
    except InputError:
        raise
    except RecursionError:
        _fail("standard input", "is nested too deeply")
    except ValueError as error:
        _fail("standard input", f"is not JSON: {error}")


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        _fail(next(n for n in names if names.count(n) > 1), "is given twice in one object")
    return found


def _check_names(
    given: Mapping[str, Any], prefix: str, required: Iterable[str], allowed: Iterable[str],
    extras: Iterable[str], needs: Iterable[str], rule: str, optional: Iterable[str] = (),
) -> None:  # fmt: skip
    """Refuse what is unknown, what the rule does not use, and what is missing, in this order."""
    needed = [name for name in extras if name in needs]
    used = [*needed, *(name for name in extras if name in optional)]
    valid = (*required, *allowed, *used)
    for name in given:
        if name in extras and name not in used:
            _fail(f"{prefix}{name}", f"is nothing that rule '{rule}' uses")
        if name not in valid:
            _fail(f"{prefix}{name}", f"is unknown.{nearest(name, valid)} Valid: {', '.join(valid)}")
    for name in (*required, *needed):
        if name not in given:
            _fail(f"{prefix}{name}", "is missing" + (f"; rule '{rule}' needs it" if name in needed else ""))


def _object(value: Any, path: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        _fail(path, f"must be an object in braces; got {_shown(value)}")
    return value


def _list(value: Any, path: str, what: str, size: int | None = None) -> list[Any]:
    if not isinstance(value, list):
        _fail(path, f"must be {what}; got {_shown(value)}")
    if not value:
        _fail(path, f"must be {what}; got an empty list")
    if size is not None and len(value) != size:
        _fail(path, f"must be {what}; got {len(value)}")
    return value


def _number(value: Any, path: str, limit: float = ABSURD) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        _fail(path, f"must be a number; got {_shown(value)}")
    if isinstance(value, float) and not math.isfinite(value):
        _fail(path, f"must be finite; got {value}")
    if abs(value) > limit:
        _fail(path, f"must not exceed {limit:g} in size; got {_shown(value)}")
    return float(value)


# Densities.


def _vector(value: Any, path: str, size: int | None) -> Array:
    what = "a list of numbers, one an axis" if size is None else f"a list of {size} numbers, one an axis of tracks[0]"
    return np.array([_number(v, f"{path}[{i}]") for i, v in enumerate(_list(value, path, what, size))])


def _matrix(value: Any, path: str, size: int) -> Array:
    what = f"{size} rows of {size} numbers"
    rows = [_list(row, f"{path}[{i}]", f"a row of {size} numbers", size)
            for i, row in enumerate(_list(value, path, what, size))]  # fmt: skip
    return np.array(
        [[_number(v, f"{path}[{i}][{j}]", ABSURD**2) for j, v in enumerate(row)] for i, row in enumerate(rows)]
    )


def _symmetric(value: Any, path: str, size: int) -> Array:
    cov = _matrix(value, path, size)
    difference = np.abs(cov - cov.T)
    if difference.max() > ASYMMETRY_TOLERANCE * np.abs(cov).max():
        i, j = sorted(int(k) for k in np.unravel_index(int(difference.argmax()), cov.shape))
        _fail(path, f"must be symmetric; [{i}][{j}] is {cov[i, j]:g}, [{j}][{i}] is {cov[j, i]:g}")
    return symmetrise(cov)


def _definite(cov: Array, path: str) -> Array:
    if not is_positive_definite(cov):
        _fail(path, f"must be positive definite; smallest eigenvalue {np.linalg.eigvalsh(cov)[0]:.3g}")
    return cov


def _semidefinite(cov: Array, path: str) -> Array:
    eigenvalues = np.linalg.eigvalsh(cov)
    if eigenvalues[0] < -ROUNDING * np.abs(eigenvalues).max():
        _fail(path, f"must be positive semi-definite; smallest eigenvalue {eigenvalues[0]:.3g}")
    return cov


def _density(given: Mapping[str, Any], path: str, size: int | None) -> _Density:
    """Read {"mean", "cov"} or {"components": [...]} of `size` axes (None: of any number)."""
    if "components" in given:
        for name in ("mean", "cov"):
            if name in given:
                _fail(f"{path}.{name}", "must not be given beside 'components', whose moments it would be")
        return _mixture(given["components"], f"{path}.components", size)
    for name in ("mean", "cov"):
        if name not in given:
            _fail(f"{path}.{name}", "is missing")
    mean = _vector(given["mean"], f"{path}.mean", size)
    cov = _definite(_symmetric(given["cov"], f"{path}.cov", len(mean)), f"{path}.cov")
    return _Density(mean, cov, Mixture(np.ones(1), mean[None], cov[None]))


def _mixture(value: Any, path: str, size: int | None) -> _Density:
    """Read components; all without covariance, they are particles."""
    weights, means, covs = [], [], []
    for i, entry in enumerate(_list(value, path, "a list of components")):
        part, at = _object(entry, f"{path}[{i}]"), f"{path}[{i}]"
        _check_names(part, f"{at}.", ("weight", "mean", "cov"), (), (), (), "")
        weights.append(_number(part["weight"], f"{at}.weight"))
        if weights[-1] < 0:
            _fail(f"{at}.weight", f"must not be negative; got {weights[-1]:g}")
        means.append(_vector(part["mean"], f"{at}.mean", size))
        size = len(means[0])
        covs.append(_symmetric(part["cov"], f"{at}.cov", size))
    weight, mean, cov = np.array(weights), np.stack(means), np.stack(covs)
    if abs(weight.sum() - 1.0) > WEIGHT_TOLERANCE:
        _fail(path, f"must have weights that sum to 1; they sum to {weight.sum():.9g}")
    if cov.any():
        for i, c in enumerate(cov):
            _definite(c, f"{path}[{i}].cov")
    weight = weight / weight.sum()
    centre = weight @ mean
    merged = np.einsum("c,cij->ij", weight, cov + outer(mean - centre))
    return _Density(centre, _definite(symmetrise(merged), path), Mixture(weight, mean, cov))


def _stacked(parts: list[Mixture]) -> Mixture:
    """Stack the mixtures of K tracks, padding with the first component at weight 0."""
    count = max(len(p.weight) for p in parts)
    padded = []
    for p in parts:
        at = [*range(len(p.weight)), *[0] * (count - len(p.weight))]
        padded.append((np.where(np.arange(count) < len(p.weight), p.weight[at], 0.0), p.mean[at], p.cov[at]))
    return Mixture(*(np.stack(arrays) for arrays in zip(*padded, strict=True)))


def _dof(value: Any, path: str) -> float:
    if value is None or value == math.inf:
        return math.inf
    dof = _number(value, path, math.inf)
    if dof <= 2:
        _fail(path, f"must exceed 2, or there is no covariance; got {dof:g}")
    return dof


# What some rules need beyond the tracks.


def _independent_covs(entries: list[Any], densities: list[_Density]) -> Array:
    covs = []
    for k, (entry, density) in enumerate(zip(entries, densities, strict=True)):
        path = f"tracks[{k}].independent_cov"
        part = _semidefinite(_symmetric(entry["independent_cov"], path, density.size), path)
        scale = np.sqrt(np.diagonal(density.cov))
        rest = np.linalg.eigvalsh((density.cov - part) / outer(scale))[0]
        if rest < -ROUNDING:
            _fail(path, f"must not exceed 'cov'; what it leaves of unit variances has the eigenvalue {rest:.3g}")
        covs.append(part)
    return np.stack(covs)


def _likelihoods(entries: list[Any], densities: list[_Density]) -> Array:
    found = []
    for k, entry in enumerate(entries):
        found.append(_number(entry["likelihood"], f"tracks[{k}].likelihood", math.inf))
        if found[-1] < 0:
            _fail(f"tracks[{k}].likelihood", f"must not be negative; got {found[-1]:g}")
    return np.array(found)


def _shared_density(value: Any, path: str, densities: list[_Density]) -> Mixture:
    given = _object(value, path)
    _check_names(given, f"{path}.", (), DENSITY, (), (), "")
    return _density(given, path, densities[0].size).parts


def _seed(value: Any, path: str, densities: list[_Density]) -> int:
    if type(value) is not int or value < 0:
        _fail(path, f"must be an integer >= 0; got {_shown(value)}")
    return value


def _cross_cov(value: Any, path: str, densities: list[_Density]) -> Array:
    """Read the blocks cov(x_i, x_j), of which those with i >= j may be null; return all, (K, K, n, n)."""
    count, n = len(densities), densities[0].size
    given = {at: _matrix(block, name, n) for at, (name, block) in _blocks(value, path, count).items()}
    whole = np.empty((count, count, n, n))
    for i, density in enumerate(densities):
        whole[i, i] = density.cov
        for j in range(i + 1, count):
            if (i, j) not in given:
                _fail(f"{path}[{i}][{j}]", f"is missing: the cross-covariance of tracks {i} and {j}")
            whole[i, j], whole[j, i] = given[i, j], given[i, j].T
    for (i, j), block in given.items():
        if np.abs(block - whole[i, j]).max() > ASYMMETRY_TOLERANCE * np.abs(whole[i, j]).max():
            wanted = f"tracks[{i}].cov" if i == j else f"the transpose of {path}[{j}][{i}]"
            _fail(f"{path}[{i}][{j}]", f"must be null or {wanted}")
    scale = np.concatenate([np.sqrt(np.diagonal(d.cov)) for d in densities])
    correlation = whole.transpose(0, 2, 1, 3).reshape(count * n, count * n) / outer(scale)
    lowest = np.linalg.eigvalsh(correlation)[0]
    if lowest < -ROUNDING:
        _fail(path, f"is larger than the covariances admit; the joint correlation has the eigenvalue {lowest:.3g}")
    return whole


def _blocks(value: Any, path: str, count: int) -> dict[tuple[int, int], tuple[str, Any]]:
    """Return name and value of each block that is given: of two tracks the one matrix, of K tracks K x K."""
    what = f"{count} rows of {count} blocks" + (", or the one block of both tracks" if count == 2 else "")
    rows = _list(value, path, what, count if count != 2 else None)
    first = rows[0][0] if isinstance(rows[0], list) and rows[0] else None
    if count == 2 and isinstance(first, int | float):
        return {(0, 1): (path, value)}
    rows = [_list(r, f"{path}[{i}]", f"{count} blocks", count) for i, r in enumerate(_list(rows, path, what, count))]
    cells = {(i, j): (f"{path}[{i}][{j}]", rows[i][j]) for i in range(count) for j in range(count)}
    return {at: cell for at, cell in cells.items() if cell[1] is not None}


_TRACK_READERS: dict[str, Callable[[list[Any], list[_Density]], Array]] = {
    "independent_cov": _independent_covs,
    "likelihood": _likelihoods,
}
_SHARED_READERS: dict[str, Callable[[Any, str, list[_Density]], Any]] = {
    "common": _shared_density,
    "target": _shared_density,
    "cross_cov": _cross_cov,
    "seed": _seed,
}
