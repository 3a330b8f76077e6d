"""What the contract suite cannot read off a rule's descriptor: examples of its parameters and of what it needs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest

from track_fusion.linalg import Array
from track_fusion.params import from_dict
from track_fusion.rules import Mixture, Rule, SourceTracks

#: Stands for one weight a source, unequal and of sum 1.
EACH: Any = ...

Values = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Example:
    """How to try one rule. A rule without an entry is tried with its defaults."""

    params: tuple[Values, ...] = ({},)
    #: (rng, tracks) -> extras, for a rule that needs more than the tracks
    extras: Callable[[np.random.Generator, SourceTracks], Mapping[str, Any]] | None = None
    #: parameters at which the rule's guarantee holds
    guaranteed: tuple[Values, ...] = ({},)
    #: parameters at which the rule is not affine equivariant, if its claim is a string
    not_equivariant: tuple[Values, ...] = ()
    #: whether the fusion of one track with itself is that track
    idempotent: bool = True
    #: for a rule that samples: how far, in standard deviations, its moments vary with the random numbers
    monte_carlo: float = 0.0
    #: (rng, tracks, count) -> (count, K n, K n): error covariances that the guarantee admits; None = every one
    joint: Callable[[np.random.Generator, SourceTracks, int], Array] | None = None
    #: for a rule whose guarantee is none or structural: the true error variance over the claimed one, and its value
    counter_example: Callable[[], tuple[float, float]] | None = None


def _naive_copies() -> tuple[float, float]:
    """Four copies of N(0, P): the docstring of the rule says that they claim P / 4 with an error of P."""
    from track_fusion.rules import RULES

    cov = np.array([[4.0, 1.0], [1.0, 2.0]])
    fused = RULES["naive"](SourceTracks(np.full((4, 2), 3.0), np.broadcast_to(cov, (4, 2, 2))))
    error = cov  # the mean of copies is the copy
    np.testing.assert_allclose(fused.mean, 3.0)
    return float(np.trace(error) / np.trace(fused.cov)), 4.0


def _overlapping_copies() -> tuple[float, float]:
    """Two copies of a track with components N(+-sqrt 2, 1), fused by powers of components."""
    from track_fusion.rules import RULES

    part = Mixture(np.full((2, 2), 0.5), np.full((2, 2, 1), 2**0.5) * [[1.0], [-1.0]], np.ones((2, 2, 1, 1)))
    fused = RULES["mixture_geometric"](SourceTracks(np.zeros((2, 1)), np.full((2, 1, 1), 3.0), mixture=part))
    return 3.0 / float(fused.cov[0, 0]), 3.0 / 2.462


def _copies_that_share_more() -> tuple[float, float]:
    """Two copies of N(0, P), said to share N(0, 2 P) only."""
    from track_fusion.rules import RULES

    cov = np.array([[4.0, 1.0], [1.0, 2.0]])
    common = Mixture(np.ones(1), np.zeros((1, 2)), 2.0 * cov[None])
    tracks = SourceTracks(np.zeros((2, 2)), np.stack([cov, cov]), extras={"common": common})
    return float(np.trace(cov) / np.trace(RULES["mixture_exact"](tracks).cov)), 1.5


def _double_counting() -> tuple[float, float]:
    """Two copies of N(0, P) by mixture_wep's method naive_bayes."""
    from track_fusion.rules import RULES

    cov, rule = np.array([[4.0, 1.0], [1.0, 2.0]]), RULES["mixture_wep"]
    tracks = SourceTracks(np.zeros((2, 2)), np.stack([cov, cov]))
    fused = rule(tracks, from_dict(rule.params, {"method": "naive_bayes"}))
    return float(np.trace(cov) / np.trace(fused.cov)), 2.0


def _few_samples() -> tuple[float, float]:
    """Two tracks of variance 1 and of equal errors, fused from fifty samples."""
    from track_fusion.rules import RULES

    rule, tracks = RULES["geometric_mean_sampling"], SourceTracks(np.array([[0.0], [1e-9]]), np.ones((2, 1, 1)))
    return 1.0 / float(rule(tracks, from_dict(rule.params, {"samples": 50})).cov[0, 0]), 1.0 / 0.831


def _vague_common(rng: np.random.Generator, tracks: SourceTracks) -> Mapping[str, Any]:
    """Common information vaguer than every track, which moves with the tracks."""
    mean, cov = tracks.mean.mean(-2), tracks.cov.sum(-3)
    part = Mixture(np.full((*mean.shape[:-1], 2), 0.5), np.stack([mean, mean], -2), np.stack([cov, 2.0 * cov], -3))
    return {"common": part}


AVERAGES: tuple[Values, ...] = ({}, {"criterion": "given", "weights": EACH})

EXAMPLES: dict[str, Example] = {
    "naive": Example(idempotent=False, counter_example=_naive_copies),
    "covariance_intersection": Example(
        params=({}, {"criterion": "trace"}, {"criterion": "uniform"}, {"criterion": "given", "weights": EACH}),
        guaranteed=({}, {"criterion": "trace"}, {"criterion": "uniform"}, {"criterion": "given", "weights": EACH}),
        not_equivariant=({"criterion": "trace"},),
    ),
    "arithmetic_average": Example(
        params=({}, {"criterion": "uniform", "output": "mixture"}, {"criterion": "given", "weights": EACH}),
        guaranteed=({"criterion": "uniform"}, {"criterion": "given", "weights": EACH}),
    ),
    "mixture_average": Example(params=(*AVERAGES, {"max_components": 3}), guaranteed=AVERAGES),
    "mixture_geometric": Example(params=AVERAGES, idempotent=False, counter_example=_overlapping_copies),
    "mixture_hybrid": Example(params=AVERAGES, idempotent=False, counter_example=_overlapping_copies),
    "mixture_wep": Example(
        params=(
            {"mixand_samples": 400, "samples": 4000},
            {"method": "igs", "samples": 4000},
            {"mixand_samples": 400, "criterion": "given", "weights": EACH},
            {"method": "foci", "criterion": "minimax_information_loss"},
            {"method": "pcci"},
        ),
        monte_carlo=0.3,
        counter_example=_double_counting,
    ),
    "geometric_mean_sampling": Example(
        params=({"samples": 20000}, {"samples": 20000, "criterion": "given", "weights": EACH}),
        monte_carlo=0.3,
        counter_example=_few_samples,
    ),
    "mixture_exact": Example(
        params=({"mixand_samples": 400}, {"method": "igs", "samples": 2000}),
        extras=_vague_common,
        idempotent=False,
        monte_carlo=0.3,
        counter_example=_copies_that_share_more,
    ),
}


def example_of(rule: Rule) -> Example:
    """Return the rule's example; a rule that needs extras, or gives no guarantee, must have one."""
    example = EXAMPLES.get(rule.key, Example())
    if rule.needs and example.extras is None:
        pytest.fail(f"test/rules/examples.py lacks 'extras' for the rule '{rule.key}', which needs {rule.needs}.")
    return example


def build(rule: Rule, values: Values, count: int) -> Any:
    """Make the rule's parameters for `count` sources."""
    share = np.arange(1.0, count + 1.0)
    filled = {k: tuple(share / share.sum()) if v is EACH else v for k, v in values.items()}
    return from_dict(rule.params, filled)


def covariances(rng: np.random.Generator, *shape: int, n: int = 4) -> Array:
    """Draw well-conditioned covariances, (*shape, n, n)."""
    root = rng.normal(size=(*shape, n, n + 3)) * rng.uniform(0.5, 2.0, size=(*shape, 1, 1))
    return root @ np.swapaxes(root, -1, -2)


def rotated(rng: np.random.Generator, eigenvalues: Array) -> Array:
    """Draw a covariance with these eigenvalues in a random orientation."""
    basis = np.linalg.qr(rng.normal(size=(len(eigenvalues),) * 2))[0]
    cov = (basis * eigenvalues) @ basis.T
    return 0.5 * (cov + cov.T)


def tracks_for(rule: Rule, rng: np.random.Generator, lead: tuple[int, ...], count: int, n: int = 4) -> SourceTracks:
    """Draw K tracks of the rule's family with what it needs; read-only, so that a rule cannot write to them."""
    mean, cov = 2.0 * rng.normal(size=(*lead, count, n)), covariances(rng, *lead, count, n=n)
    dof = np.full(mean.shape[:-1], 5.0) if rule.family == "elliptical" else None
    mixture = None
    if rule.family == "mixture":
        # Two components at mean +- d of covariance P - d d' have the moments of the track.
        offset = 0.5 * np.linalg.cholesky(cov)[..., 0]
        part = np.stack([mean + offset, mean - offset], -2)
        narrow = cov - offset[..., :, None] * offset[..., None, :]
        mixture = Mixture(np.full(part.shape[:-1], 0.5), part, np.stack([narrow, narrow], -3))
    return with_extras(rule, rng, SourceTracks(mean, cov, dof, mixture))


def with_extras(rule: Rule, rng: np.random.Generator, tracks: SourceTracks) -> SourceTracks:
    """Add what the rule needs, and make all arrays read-only."""
    maker = example_of(rule).extras
    tracks = dataclasses.replace(tracks, extras={} if maker is None else maker(rng, tracks))
    for array in arrays_of(tracks):
        array.flags.writeable = False
    return tracks


def arrays_of(tracks: SourceTracks) -> list[Array]:
    """List all arrays of the tracks."""
    found = [tracks.mean, tracks.cov]
    found += [tracks.dof] if tracks.dof is not None else []
    found += list(vars(tracks.mixture).values()) if tracks.mixture is not None else []
    for extra in tracks.extras.values():
        found += [extra] if isinstance(extra, np.ndarray) else []
        found += list(vars(extra).values()) if isinstance(extra, Mixture) else []
    return found


def select(tracks: SourceTracks, index: Any) -> SourceTracks:
    """Index every array of the tracks alike: by batch axes, or (..., order) by source."""

    def pick(array: Array, trailing: int) -> Array:
        return array[(*index, *(slice(None),) * trailing)] if isinstance(index, tuple) else array[index]

    mixture = tracks.mixture and Mixture(
        pick(tracks.mixture.weight, 1), pick(tracks.mixture.mean, 2), pick(tracks.mixture.cov, 3)
    )
    dof = None if tracks.dof is None else pick(tracks.dof, 0)
    extras = {k: _select_extra(v, index) for k, v in tracks.extras.items()}
    return SourceTracks(pick(tracks.mean, 1), pick(tracks.cov, 2), dof, mixture, extras)


def _select_extra(extra: Any, index: Any) -> Any:
    """Index an extra like the tracks; a mixture has no axis of sources."""
    if isinstance(extra, Mixture):
        return extra.at(index[: extra.weight.ndim - 1])
    return extra[index] if isinstance(extra, np.ndarray) else extra
