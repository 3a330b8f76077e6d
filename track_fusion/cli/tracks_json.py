"""Tracks as JSON: read what `track-fusion fuse` takes, write what it gives. Every error names its field."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NoReturn

import numpy as np

from track_fusion.angles import HALF_TURN, TURN, named_period, periods_of, wrap
from track_fusion.cli.tracks_schema import InputError, check, shared_schema, tracks_schema
from track_fusion.densities.mixture.mixture import moments, stacked
from track_fusion.linalg import ASYMMETRY_TOLERANCE, Array, asymmetric, is_positive_definite, outer, symmetrise
from track_fusion.rules import FusedTracks, Mixture, SourceTracks
from track_fusion.tracks import WEIGHT_TOLERANCE

#: Within so many standard deviations of their difference two angles are near each other.
NEAR_SD = 4.0
#: How far below zero, beside the largest, an eigenvalue of a semi-definite matrix may be by rounding.
ROUNDING = 1e-9


def read_tracks(text: bytes, needs: Collection[str], rule: str, optional: Collection[str] = ()) -> SourceTracks:
    """Read the tracks that a rule is to fuse.

    Parameters
    ----------
    text               JSON of the form that the help of `track-fusion fuse` gives
    needs, optional    names of the extras that the rule needs, and of those that it can use; others are refused
    rule               its key, for messages

    Returns
    -------
    SourceTracks    of one fusion: mean (K, n), cov (K, n, n), the periods of its axes where they are named, and
                    `extras` as arrays: independent_cov (K, n, n), likelihood (K,), cross_cov (K, K, n, n) whose
                    diagonal blocks are the tracks' own covariances, common and target as Mixture of (C,), (C, n),
                    (C, n, n) (a Gaussian has one component), seed int

    Raises
    ------
    InputError    a field is missing, unknown, not needed, of a wrong form, or holds a wrong value
    """
    data = _parse(text)
    check(data, tracks_schema(_axes(data), needs, rule, optional))
    tracks, periods = data["tracks"], _periods(data)
    mixtures = [_mixture(track, f"tracks[{k}]", periods) for k, track in enumerate(tracks)]
    merged = [moments(mixture, periods) for mixture in mixtures]
    mean, cov = (np.stack(arrays) for arrays in zip(*merged, strict=True))
    dof = np.array([np.inf if track.get("dof") is None else track["dof"] for track in tracks], float)
    known_dof = dof if np.isfinite(dof).any() else None
    parts = stacked(*mixtures) if any("components" in track for track in tracks) else None
    return SourceTracks(mean, cov, known_dof, parts, _extras(data, cov, periods), periods)


def like_angles(tracks: SourceTracks) -> list[int]:
    """Return the axes whose numbers look like angles that nobody named: a turn brings tracks together.

    They lie between plus and minus a turn, two of them far apart as numbers, and near each other on the circle.
    """
    if tracks.periods:
        return []
    plain = tracks.mean[:, None] - tracks.mean[None]
    sd = np.sqrt(np.diagonal(tracks.cov, axis1=-2, axis2=-1))
    reach = NEAR_SD * np.hypot(sd[:, None], sd[None])
    turned = (np.abs(plain) > np.maximum(reach, HALF_TURN)) & (np.abs(wrap(plain, TURN)) <= reach)
    small = (np.abs(tracks.mean) <= TURN).all(0)
    return [int(i) for i in np.flatnonzero(small & turned.any((0, 1)))]


def write_fused(fused: FusedTracks) -> dict[str, Any]:
    """Describe the fused track: mean, cov, dof (None: Gaussian), weights, info, components (None: no mixture).

    Raises
    ------
    ValueError    the fused state is not finite
    """
    if not (np.isfinite(fused.mean).all() and np.isfinite(fused.cov).all()):
        raise ValueError("The fused mean or covariance is not finite: the tracks are too extreme for this rule.")
    components = None
    if fused.mixture is not None:
        rows = zip(fused.mixture.weight, fused.mixture.mean, fused.mixture.cov, strict=True)
        # Weight 0 only pads tracks of fewer components.
        components = [{"weight": w, "mean": m, "cov": c} for w, m, c in rows if w > 0]
    beside = {"weights": fused.weights, "info": fused.info, "components": components}
    return {"mean": fused.mean, "cov": fused.cov, "dof": fused.dof, **beside}


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
    names = [name for name, _ in pairs]
    for name in names:
        if names.count(name) > 1:
            _fail(name, "is given twice in one object")
    return dict(pairs)


def _axes(data: Any) -> int | None:
    """Count the axes of the first track; None where it has no list of them, which is an error by itself."""
    try:
        first = data["tracks"][0]
        mean = first["mean"] if "mean" in first else first["components"][0]["mean"]
    except (LookupError, TypeError):
        return None
    return len(mean) or None if isinstance(mean, list) else None


def _fail(place: str, text: str) -> NoReturn:
    raise InputError(f"{place}: {text}")


def _periods(data: Mapping[str, Any]) -> tuple[float, ...]:
    """Read which axes wrap: those of known names, and those that "angular" names."""
    if "axes" not in data:
        if "angular" in data:
            _fail("axes", "is missing; 'angular' names some of them")
        return ()
    axes, angular = data["axes"], data.get("angular", [])
    if len(set(axes)) < len(axes):
        _fail("axes", f"must be distinct names; got {json.dumps(axes)}")
    periods: dict[str, float] = {}
    for k, spelt in enumerate(angular):
        name, period = named_period(spelt)
        if name not in axes:
            _fail(f"angular[{k}]", f"must be one of the axes {', '.join(axes)}; got {json.dumps(spelt)}")
        if name in periods:
            _fail(f"angular[{k}]", f"names {name} once more; got {json.dumps(spelt)}")
        periods[name] = period
    return periods_of(axes, periods)


# Densities.


def _mixture(given: Mapping[str, Any], place: str, periods: Sequence[float]) -> Mixture:
    """Read {"mean", "cov"} as one component, or {"components"}; all without covariance, these are particles."""
    if "components" not in given:
        cov = _symmetric(given["cov"], f"{place}.cov")
        _check_definite(cov, f"{place}.cov")
        return Mixture(np.ones(1), np.array([given["mean"]], float), cov[None])
    parts, place = given["components"], f"{place}.components"
    weight, mean = (np.array([part[name] for part in parts], float) for name in ("weight", "mean"))
    covs = np.stack([_symmetric(part["cov"], f"{place}[{i}].cov") for i, part in enumerate(parts)])
    if abs(weight.sum() - 1.0) > WEIGHT_TOLERANCE:
        _fail(place, f"must have weights that sum to 1; they sum to {weight.sum():.9g}")
    if covs.any():
        for i, cov in enumerate(covs):
            _check_definite(cov, f"{place}[{i}].cov")
    mixture = Mixture(weight, mean, covs).normalised
    _check_definite(moments(mixture, periods)[1], place)
    return mixture


def _symmetric(given: Any, place: str) -> Array:
    cov = np.array(given, float)
    if asymmetric(cov):
        i, j = sorted(int(k) for k in np.unravel_index(int(np.abs(cov - cov.T).argmax()), cov.shape))
        _fail(place, f"must be symmetric; [{i}][{j}] is {cov[i, j]:g}, [{j}][{i}] is {cov[j, i]:g}")
    return symmetrise(cov)


def _check_definite(cov: Array, place: str) -> None:
    if not is_positive_definite(cov):
        _fail(place, f"must be positive definite; smallest eigenvalue {np.linalg.eigvalsh(cov)[0]:.3g}")


# What some rules need beyond the tracks.


def _extras(data: Mapping[str, Any], cov: Array, periods: Sequence[float]) -> dict[str, Any]:
    """Read all that is there; of what stands in the tracks, what all of them have."""
    extras: dict[str, Any] = {}
    if all("independent_cov" in track for track in data["tracks"]):
        parts = [_independent(t["independent_cov"], k, cov[k]) for k, t in enumerate(data["tracks"])]
        extras["independent_cov"] = np.stack(parts)
    if all("likelihood" in track for track in data["tracks"]):
        extras["likelihood"] = np.array([track["likelihood"] for track in data["tracks"]], float)
    check(data, shared_schema(*cov.shape[:2]))
    extras |= {name: _mixture(data[name], name, periods) for name in ("common", "target") if name in data}
    extras |= {"cross_cov": _cross_cov(data["cross_cov"], cov)} if "cross_cov" in data else {}
    return extras | ({"seed": data["seed"]} if "seed" in data else {})


def _independent(given: Any, k: int, cov: Array) -> Array:
    place = f"tracks[{k}].independent_cov"
    part = _symmetric(given, place)
    eigenvalues = np.linalg.eigvalsh(part)
    if eigenvalues[0] < -ROUNDING * np.abs(eigenvalues).max():
        _fail(place, f"must be positive semi-definite; smallest eigenvalue {eigenvalues[0]:.3g}")
    rest = np.linalg.eigvalsh((cov - part) / outer(np.sqrt(np.diagonal(cov))))[0]
    if rest < -ROUNDING:
        _fail(place, f"must not exceed 'cov'; what it leaves of unit variances has the eigenvalue {rest:.3g}")
    return part


def _cross_cov(given: Any, cov: Array) -> Array:
    """Read the blocks cov(x_i, x_j), of which those with i >= j may be null; return all, (K, K, n, n)."""
    count, n = cov.shape[:2]
    blocks = given if isinstance(given[0][0], list | None) else [[None, given], [None, None]]
    whole = np.zeros((count, count, n, n))
    for i, j in np.ndindex(count, count):
        if i < j and blocks[i][j] is None:
            _fail(f"cross_cov[{i}][{j}]", f"is missing: the cross-covariance of tracks {i} and {j}")
        whole[i, j] = cov[i] if i == j else blocks[i][j] if i < j else whole[j, i].T
        off = 0.0 if blocks[i][j] is None else np.abs(np.array(blocks[i][j], float) - whole[i, j]).max()
        if off > ASYMMETRY_TOLERANCE * np.abs(whole[i, j]).max():
            wanted = f"tracks[{i}].cov" if i == j else f"the transpose of cross_cov[{j}][{i}]"
            _fail(f"cross_cov[{i}][{j}]", f"must be null or {wanted}")
    scale = np.sqrt(np.diagonal(cov, axis1=1, axis2=2)).ravel()
    correlation = whole.transpose(0, 2, 1, 3).reshape(count * n, count * n) / outer(scale)
    if (lowest := np.linalg.eigvalsh(correlation)[0]) < -ROUNDING:
        _fail(
            "cross_cov", f"is larger than the covariances admit; the joint correlation has the eigenvalue {lowest:.3g}"
        )
    return whole
