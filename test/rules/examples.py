"""What the contract suite cannot read off a rule's descriptor: examples of its parameters and of what it needs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest

from track_fusion.linalg import Array
from track_fusion.params import from_dict
from track_fusion.rules import FusedTracks, Mixture, Rule, SourceTracks

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
    #: where parameters name a number of samples: how far, in standard deviations, moments may vary with the random
    #: numbers if every sample is effective
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

    rule = RULES["geometric_mean_sampling"]
    tracks = SourceTracks(np.array([[0.0], [1e-9]]), np.ones((2, 1, 1)), extras={"seed": 1})
    return 1.0 / float(rule(tracks, from_dict(rule.params, {"samples": 50})).cov[0, 0]), 1.0 / 0.765


def _vague_common(rng: np.random.Generator, tracks: SourceTracks) -> Mapping[str, Any]:
    """Common information vaguer than every track, which moves with the tracks."""
    mean, cov = tracks.mean.mean(-2), tracks.cov.sum(-3)
    part = Mixture(np.full((*mean.shape[:-1], 2), 0.5), np.stack([mean, mean], -2), np.stack([cov, 2.0 * cov], -3))
    return {"common": part}


def _diagonal_pair(key: str, ratio: float, values: Values, cross: Array) -> float:
    """Fuse diag(1, r) and diag(r, 1); return the error variance over the claim, along (1, 1), at this correlation."""
    from track_fusion.rules import RULES

    rule, cov = RULES[key], np.stack([np.diag([1.0, ratio]), np.diag([ratio, 1.0])])
    joint = np.block([[cov[0], cross], [cross.T, cov[1]]])
    assert np.linalg.eigvalsh(joint).min() > -1e-12  # the cross-covariance is admissible
    probes = np.concatenate([np.eye(4), np.zeros((1, 4))]).reshape(5, 2, 2)
    fused = rule(SourceTracks(probes, np.broadcast_to(cov, (5, 2, 2, 2))), from_dict(rule.params, values))
    gain, along = fused.mean[:4].T, np.ones(2)
    return float(along @ gain @ joint @ gain.T @ along / (along @ fused.cov[4] @ along))


def _inverse_intersection() -> tuple[float, float]:
    return _diagonal_pair("inverse_covariance_intersection", 4.0, {}, np.array([[0.0, 1.0], [4.0, 0.0]])), 1.53


def _ellipsoidal_intersection() -> tuple[float, float]:
    """The errors of the two sharp axes are equal: cov(e1, e2)[0, 1] = 1."""
    return _diagonal_pair("ellipsoidal_intersection", 4.0, {}, np.array([[0.0, 1.0], [0.0, 0.0]])), 2.0


def _quadrature(count: int = 48) -> tuple[Array, Array]:
    """Nodes (count^2, 2) and weights of expectations over two independent standard normal variables."""
    x, w = np.polynomial.hermite_e.hermegauss(count)
    return np.stack(np.meshgrid(x, x, indexing="ij"), -1).reshape(-1, 2), np.outer(w, w).ravel() / w.sum() ** 2


def _fast_intersection() -> tuple[float, float]:
    """P1 = diag(1, 12), P2 = diag(12, 1), e2 = P2^1/2 R P1^-1/2 e1 with R a turn by 40 degrees."""
    from track_fusion.rules import RULES

    z, weight = _quadrature()
    turn = np.deg2rad(40.0)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    cov = np.stack([np.diag([1.0, 12.0]), np.diag([12.0, 1.0])])
    errors = np.stack([z @ np.sqrt(cov[0]), z @ rotation.T @ np.sqrt(cov[1])], 1)
    fused = RULES["fast_covariance_intersection"](SourceTracks(errors, np.broadcast_to(cov, (len(z), 2, 2, 2))))
    error = np.einsum("b,bi,bj->ij", weight, fused.mean, fused.mean)
    claim = np.einsum("b,bij->ij", weight, fused.cov)
    return float(np.linalg.eigvals(np.linalg.solve(claim, error)).real.max()), 1.043


def scalar_nees(variances: tuple[float, float], correlation: float, values: Values) -> float:
    """Mean of the squared error over the claim of the harmonic mean of two scalar tracks, by summation over a grid."""
    from track_fusion.rules import RULES

    axis = np.linspace(-8.0, 8.0, 401)
    z = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    weight = np.exp(-0.5 * (z**2).sum(1))
    first = z[:, 0]
    second = correlation * z[:, 0] + np.sqrt(1.0 - correlation**2) * z[:, 1]
    mean = np.stack([first, second], 1) * np.sqrt(variances)
    rule, cov = RULES["harmonic_mean"], np.broadcast_to(np.array(variances)[:, None, None], (len(z), 2, 1, 1))
    fused = rule(SourceTracks(mean[..., None], cov), from_dict(rule.params, values))
    return float((weight * fused.mean[:, 0] ** 2 / fused.cov[:, 0, 0]).sum() / weight.sum())


def shared_cross_cov(tracks: SourceTracks) -> Array:
    """Cross-covariances P_i C^-1 P_j of tracks that share a part of covariance C = sum of all P, (..., K, K, n, n)."""
    common = np.linalg.inv(tracks.cov.sum(-3))[..., None, None, :, :]
    return tracks.cov[..., :, None, :, :] @ common @ tracks.cov[..., None, :, :, :]


def _shared_joint(rng: np.random.Generator, tracks: SourceTracks, count: int) -> Array:
    """The one joint covariance that the given cross-covariances leave."""
    cross, (sources, n) = shared_cross_cov(tracks), tracks.mean.shape
    cross[np.arange(sources), np.arange(sources)] = tracks.cov
    return np.broadcast_to(cross.swapaxes(-3, -2).reshape(sources * n, sources * n), (count, sources * n, sources * n))


def _independent_parts(rng: np.random.Generator, tracks: SourceTracks) -> Mapping[str, Any]:
    """A part of each track that moves with it under affine maps and is not a multiple of it."""
    cov, total = tracks.cov, tracks.cov.sum(-3, keepdims=True)
    return {"independent_cov": 0.1 * cov + 0.5 * cov @ np.linalg.inv(total) @ cov}


def _split_joint(rng: np.random.Generator, tracks: SourceTracks, count: int) -> Array:
    """Joint covariances whose independent parts are independent, and whose other parts are correlated in any way."""
    alone = tracks.extras["independent_cov"]
    joint = joint_covariances(rng, tracks.cov - alone, count)
    n = tracks.mean.shape[-1]
    for k, part in enumerate(alone):
        joint[:, k * n : (k + 1) * n, k * n : (k + 1) * n] += part
    return joint


def _target_and_likelihood(rng: np.random.Generator, tracks: SourceTracks) -> Mapping[str, Any]:
    """A target that moves with the tracks: two components; likelihoods that any set of axes gives."""
    mean = np.stack([tracks.mean.mean(-2), tracks.mean[..., -1, :]], -2)
    cov = np.stack([tracks.cov.mean(-3)] * 2, -3)
    target = Mixture(np.broadcast_to([0.5, 0.5], mean.shape[:-1]).copy(), mean, cov)
    size = np.linalg.slogdet(tracks.cov)[1]
    return {"target": target, "likelihood": np.exp(0.1 * (size - size.mean(-1, keepdims=True)))}


def joint_covariances(rng: np.random.Generator, cov: Array, count: int) -> Array:
    """Draw joint error covariances (count, K n, K n) with these diagonal blocks, from slack to fully dependent."""
    sources, n = cov.shape[:2]
    size = sources * n
    joint = np.empty((count, size, size))
    for i in range(count):
        rank = rng.integers(n, size + 3)  # rank n: each source's error is a function of any other's
        root = rng.normal(size=(sources, n, rank)) * 10.0 ** rng.normal(size=rank)
        # Each block of rows is made orthonormal, then coloured by its track's covariance.
        root = np.swapaxes(np.linalg.qr(np.swapaxes(root, -1, -2))[0], -1, -2)
        coloured = (np.linalg.cholesky(cov) @ root).reshape(size, rank)
        joint[i] = coloured @ coloured.T
    return joint


GIVEN: Values = {"criterion": "given", "weights": EACH}
TRACE: Values = {"criterion": "trace"}
UNIFORM: Values = {"criterion": "uniform"}
AVERAGES: tuple[Values, ...] = ({}, GIVEN)


def _shared_error(key: str, stated: float) -> Callable[[], tuple[float, float]]:
    """Three scalar tracks of variance 1: an error of 10 that a random pair shares in 1.5 % of all cases."""

    def ratio() -> tuple[float, float]:
        from track_fusion.rules import RULES

        error, chance = np.array([10.0, 0.0]), np.array([0.015, 0.985])
        mean = error[:, None, None] * np.array([1.0, 1.0, 0.0])[:, None]
        assert chance @ (error**2 * 2.0 / 3.0) == pytest.approx(1.0)  # the variance of each track, over all pairs
        fused = RULES[key](SourceTracks(mean, np.ones((2, 3, 1, 1))))
        return float(chance @ fused.mean[:, 0] ** 2 / (chance @ fused.cov[:, 0, 0])), stated

    return ratio


_GENERALIZED: Values = {"family": "generalized_gaussian", "beta": 0.7}

EXAMPLES: dict[str, Example] = {
    "naive": Example(idempotent=False, counter_example=_naive_copies),
    "covariance_intersection": Example(
        params=({}, TRACE, UNIFORM, GIVEN), guaranteed=({}, TRACE, UNIFORM, GIVEN), not_equivariant=(TRACE,)
    ),
    "fast_covariance_intersection": Example(counter_example=_fast_intersection),
    "fault_tolerant_covariance_intersection": Example(
        params=({}, {**TRACE, "delta": 0.5}, GIVEN), guaranteed=({}, GIVEN), idempotent=False,
        not_equivariant=({**TRACE, "delta": 0.5},),
    ),
    "inverse_covariance_intersection": Example(
        params=({}, TRACE, GIVEN), not_equivariant=(TRACE,), counter_example=_inverse_intersection
    ),
    "ellipsoidal_intersection": Example(counter_example=_ellipsoidal_intersection),
    "covariance_union": Example(
        params=(
            {}, TRACE, {"weights": EACH}, {"mean": "diversity"}, {"mean": "optimal"},
            {**TRACE, "mean": "optimal"}, {"bound": "max_trace"},
            {"bound": "min_trace"},
        ),
        guaranteed=({}, TRACE),
        not_equivariant=(TRACE, {**TRACE, "mean": "optimal"}, {"bound": "max_trace"}, {"bound": "min_trace"}),
    ),
    "geometric_average": Example(
        params=({}, {"criterion": "chernoff"}, {"criterion": "minimax_information_loss"}, GIVEN),
        guaranteed=({}, GIVEN),
    ),
    "arithmetic_average": Example(
        params=(
            {}, {**UNIFORM, "output": "mixture"}, GIVEN, {"criterion": "bound"}, {"criterion": "target"},
            {"criterion": "likelihood"}, {"output": "mixture", "merge_threshold": 1.5},
        ),
        guaranteed=(UNIFORM, GIVEN),
        extras=_target_and_likelihood,
    ),
    "mixture_average": Example(params=(*AVERAGES, {"max_components": 3}), guaranteed=AVERAGES),
    "mixture_geometric": Example(params=AVERAGES, idempotent=False, counter_example=_overlapping_copies),
    "mixture_hybrid": Example(params=AVERAGES, idempotent=False, counter_example=_overlapping_copies),
    "mixture_wep": Example(
        params=(
            {"mixand_samples": 400, "samples": 4000},
            {"method": "igs", "samples": 4000},
            {"mixand_samples": 400, "criterion": "given", "weights": EACH},
            {"method": "foci", "criterion": "minimax_information_loss", "samples": 4000},
            {"method": "pcci"},
        ),
        monte_carlo=0.3,
        counter_example=_double_counting,
    ),
    "geometric_mean_sampling": Example(
        params=({"samples": 5000}, {**GIVEN, "samples": 5000}),
        monte_carlo=0.15,
        counter_example=_few_samples,
    ),
    "mixture_exact": Example(
        params=({"mixand_samples": 400}, {"method": "igs", "samples": 2000}),
        extras=_vague_common,
        idempotent=False,
        monte_carlo=0.3,
        counter_example=_copies_that_share_more,
    ),
    "harmonic_mean": Example(
        params=({}, TRACE, GIVEN, {"method": "sampling", "samples": 5000}), not_equivariant=(TRACE,), monte_carlo=0.15,
        counter_example=lambda: (scalar_nees((1.0, 10.0), 0.9, {}), 1.09),
    ),
    "cross_covariance": Example(
        params=({}, {"method": "given"}), guaranteed=({"method": "given"},), idempotent=False,
        extras=lambda rng, tracks: {"cross_cov": shared_cross_cov(tracks)}, joint=_shared_joint,
    ),
    "split_covariance_intersection": Example(
        params=({}, TRACE, UNIFORM, GIVEN), guaranteed=({}, TRACE, UNIFORM, GIVEN), idempotent=False,
        not_equivariant=(TRACE,), extras=_independent_parts, joint=_split_joint,
    ),
    "mhdp_explicit": Example(
        params=({}, {"criterion": "unsquared"}, _GENERALIZED), counter_example=_shared_error("mhdp_explicit", 1.36)
    ),
    "mhdp_iterative": Example(
        params=({}, {"criterion": "unsquared"}, {"scatter": "intersection"}, _GENERALIZED),
        counter_example=_shared_error("mhdp_iterative", 1.36),
    ),
    "quasi_minimal_manhattan": Example(
        params=({}, _GENERALIZED), counter_example=_shared_error("quasi_minimal_manhattan", 1.26)
    ),
    "geodesic_projection": Example(
        params=({}, {"family": "student_t"}, _GENERALIZED), counter_example=_shared_error("geodesic_projection", 1.42)
    ),
}  # fmt: skip


def tolerance_of(rule: Rule, values: Values, fused: FusedTracks, exact: float) -> Array:
    """Tolerance of a law for each fusion of a batch: `exact`, unless these parameters make the rule sample."""
    if not any("samples" in name for name in values):
        return np.full(fused.mean.shape[:-1], exact)
    effective = np.asarray(fused.info.get("ess", np.ones(fused.mean.shape[:-1])))
    return np.maximum(exact, example_of(rule).monte_carlo / np.sqrt(effective))


def example_of(rule: Rule) -> Example:
    """Return the rule's example; a rule that needs extras, or gives no guarantee, must have one."""
    example = EXAMPLES.get(rule.key, Example())
    needs = (*rule.needs, *(name for name, _, _ in rule.needs_when))
    if needs and example.extras is None:
        pytest.fail(f"test/rules/examples.py lacks 'extras' for the rule '{rule.key}', which needs {needs}.")
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
        found += list(vars(extra).values()) if isinstance(extra, Mixture) else []
        found += [extra] if isinstance(extra, np.ndarray) else []
    return found


def select(tracks: SourceTracks, index: Any) -> SourceTracks:
    """Index every array of the tracks alike: by batch axes, or (..., order) by source."""
    index = index if isinstance(index, tuple) else (index,)
    batch = index[: tracks.mean.ndim - 2]

    def pick(array: Array, trailing: int) -> Array:
        return array[(*index, *(slice(None),) * trailing)]

    def pick_extra(name: str, extra: Any) -> Any:
        if isinstance(extra, Mixture):  # of all sources together
            return Mixture(*(array[batch] for array in vars(extra).values()))
        if not isinstance(extra, np.ndarray):
            return extra
        if name == "cross_cov" and len(index) > len(batch):  # both sources of a block
            return extra[index][(*(slice(None),) * len(batch), slice(None), index[-1])]
        return extra[index]

    mixture = tracks.mixture and Mixture(
        pick(tracks.mixture.weight, 1), pick(tracks.mixture.mean, 2), pick(tracks.mixture.cov, 3)
    )
    dof = None if tracks.dof is None else pick(tracks.dof, 0)
    extras = {name: pick_extra(name, extra) for name, extra in tracks.extras.items()}
    return SourceTracks(pick(tracks.mean, 1), pick(tracks.cov, 2), dof, mixture, extras)
