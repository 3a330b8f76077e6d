"""Weighted exponential product of Gaussian mixtures: Chernoff fusion, for unknown common information."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.log_domain import log_of, normalised
from track_fusion.densities.mixture.algebra import LogMixture, first_order, product
from track_fusion.densities.mixture.exponent import PROPOSAL_OMEGA, Omega, optimise_omega, overlap_proposal
from track_fusion.densities.mixture.mixture import Mixture, chosen, same, stacked
from track_fusion.densities.mixture.proposals import prune_mixands
from track_fusion.densities.mixture.quotient import Laplace, laplace, wep_bound, wep_quotient
from track_fusion.densities.mixture.sampling import single_shot_em, weighted_em
from track_fusion.linalg import Array
from track_fusion.params import param
from track_fusion.rules import covariance_intersection
from track_fusion.rules.base import Example, FusedTracks, Rule, SourceTracks
from track_fusion.rules.geometric_average import GeometricAverageParams
from track_fusion.rules.geometric_average import fuse as geometric_average
from track_fusion.rules.shared.folding import Step, fold_mixtures, share_of_first
from track_fusion.rules.shared.quotients import (
    QuotientParams,
    closed_form_where,
    either,
    has_one_component,
    heaviest,
    multiply,
    sample_mixands,
)
from track_fusion.rules.shared.sampling import Generators, fuse_sampled
from track_fusion.rules.shared.weights import GIVEN, WeightParams


@dataclasses.dataclass(frozen=True)
class MixtureWepParams(WeightParams, QuotientParams):
    """How the exponent omega is chosen and how the product of powers becomes a mixture."""

    method: str = param(
        "dls",
        "dls: sample each mixand, igs: sample the whole and share out, is_wem: the same by expectation maximisation, "
        "foci: first-order approximation, pcci: a covariance intersection of each pair, naive_bayes: the plain product",
        choices=("dls", "igs", "is_wem", "foci", "pcci", "naive_bayes"),
    )
    criterion: str = param(
        "chernoff",
        "exponent omega: as far from either density (chernoff), nearest to naive fusion (minimax_information_loss), "
        "or given by 'weights'",
        choices=("chernoff", "minimax_information_loss", "given"),
    )
    omega_proposal: str = param(
        "overlap",
        "what the search for omega, igs and is_wem sample from: products of powers of components, weighted by their "
        "overlap, or without regard to it, as foci and the paper have it (first_order)",
        choices=("overlap", "first_order"),
    )
    omega_error: float = param(
        0.02,
        "the search for omega doubles its samples until two standard errors of omega are no more than this; 1: never",
        low=0.0, high=1.0, strict=True,
    )  # fmt: skip
    max_omega_samples: int = param(64000, "most samples of the search for omega, which starts with 'samples'", low=10)


def fuse(tracks: SourceTracks, params: MixtureWepParams) -> FusedTracks:
    """Fuse pairs of mixtures by the weighted exponential product p1^w p2^(1 - w), in the order of the sources.

    Counts information that the sources share exactly once, whatever it is; what the product loses, it loses of each
    source's own information.

    Parameters
    ----------
    tracks : SourceTracks    mixture (..., K, C), or Gaussian tracks; each normalised first; extras["seed"]: int or
                             Generator, 0 if absent
    params : MixtureWepParams

    Returns
    -------
    FusedTracks    mixture; mean (..., n) and cov (..., n, n) are its moments; weights (..., K); info converged
                   (false also where omega_error is larger than asked for), iterations, omega_error (two standard
                   errors of omega, the largest of several), ess (least share of samples that are effective), log_eta
                   (log of the integral of the product: very low for disjoint densities), pruned (bound on the
                   share of weight not sampled)

    Raises
    ------
    ValueError     given weights do not fit, or a component has no covariance

    Notes          One component of any weight each: the geometric average of Gaussians, without sampling. Equal
                   mixtures come back, and weights 0 and 1 give a source itself. Else sampled: moments vary with the
                   seed by about a standard deviation over the root of the number of effective samples.
                   No guarantee for mixtures: naive_bayes, for one, claims half of P for two copies of a track
                   whose error has covariance P. O(C^2 S n^2) for S samples a mixand.
    References     N. R. Ahmed, Decentralized Gaussian Mixture Fusion through Unified Quotient Approximations,
                   eqs. (7)-(11), (14)-(17), (23)-(25), Algorithms 1, 2, 3 and 5.
    """
    given = params.given(tracks.count)

    def fuse_piece(piece: SourceTracks, rngs: Generators) -> FusedTracks:
        def step(first: Mixture, second: Mixture, k: int) -> Step:
            share = None if given is None else share_of_first(given, k)
            return _fuse_pair(first, second, params, rngs[k - 1], share)

        return fold_mixtures(piece, params, step, TOLD)

    return fuse_sampled(tracks, params.points(tracks), fuse_piece)


def _fuse_pair(
    first: Mixture, second: Mixture, params: MixtureWepParams, rng: np.random.Generator, share: float | None
) -> Step:
    if params.method == "naive_bayes":
        return multiply(first, second)
    if params.method == "pcci":
        return _sample_pair(first, second, params, rng, share)
    return closed_form_where(
        has_one_component(first) & has_one_component(second),
        lambda: _fuse_gaussians(heaviest(first), heaviest(second), params.criterion, share),
        lambda: _sample_pair(first, second, params, rng, share),
    )


def _sample_pair(
    first: Mixture, second: Mixture, params: MixtureWepParams, rng: np.random.Generator, share: float | None
) -> Step:
    given = None if share is None else np.full(first.weight.shape[:-1], share)
    proposal = PROPOSALS[params.omega_proposal](first, second)
    search = optimise_omega(
        first, second, rng, params.samples, params.criterion, given, proposal, params.omega_error,
        params.max_omega_samples,
    )  # fmt: skip
    how = {"converged": search.converged, "iterations": search.iterations, "omega_error": search.error}
    drawn = {"ess": search.samples.ess / params.samples, "log_eta": search.samples.log_eta}
    # At the ends, and of equal sources, one source is the answer; 1/2 keeps the rest finite there.
    ends = (search.omega == 0.0) | (search.omega == 1.0) | same(first, second)
    inside = search._replace(omega=np.where(ends, 0.5, search.omega))
    fused, more = METHODS[params.method](first, second, inside, params, rng)
    omega = None if params.method == "pcci" else search.omega
    answer = Step(chosen(search.omega > 0.0, first, second), omega, how)
    return either(ends, answer, Step(fused, omega, how | drawn | more))


#: The diagnostics of a fusion.
TOLD = ("converged", "iterations", "omega_error", "ess", "log_eta", "pruned")
#: What Algorithm 1 draws from.
PROPOSALS: dict[str, Callable[[Mixture, Mixture], Mixture]] = {
    "overlap": overlap_proposal,
    "first_order": lambda first, second: first_order(first, second, np.full(first.weight.shape[:-1], PROPOSAL_OMEGA)),
}


def _fuse_gaussians(first: Mixture, second: Mixture, criterion: str, share: float | None) -> Step:
    """Fuse single components (...) exactly: the geometric average of Gaussians, without sampling."""
    both = stacked(first, second)
    given = () if share is None else (share, 1.0 - share)
    params = GeometricAverageParams(criterion=criterion, weights=given)
    fused = geometric_average(SourceTracks(both.mean[..., 0, :], both.cov[..., 0, :, :]), params)
    assert fused.weights is not None
    omega = fused.weights[..., 0]
    inside = (omega > 0.0) & (omega < 1.0)
    integral = wep_bound(first, second, np.where(inside, omega, 0.5))[..., 0]
    info = {**fused.info, "log_eta": np.where(inside, integral, 0.0)}
    one = np.ones((*omega.shape, 1))
    return Step(Mixture(one, fused.mean[..., None, :], fused.cov[..., None, :, :]), omega, info)


Result = tuple[Mixture, dict[str, NDArray[Any]]]
Method = Callable[[Mixture, Mixture, Omega, MixtureWepParams, np.random.Generator], Result]


def _dls(first: Mixture, second: Mixture, search: Omega, params: MixtureWepParams, rng: np.random.Generator) -> Result:
    bound = wep_bound(first, second, search.omega)
    # The mixands sum to the whole integral, of which Algorithm 1 has an estimate: one is no less than the mean.
    likely = np.broadcast_to((search.samples.log_eta - np.log(bound.shape[-1]))[..., None], bound.shape)
    kept = prune_mixands(wep_quotient(first, second, search.omega), bound, likely, params.prune_nats)

    def above(near: Laplace) -> tuple[Array, Array]:
        whole = first_order(first, second, search.omega).take(kept.order)
        return whole.mean, whole.cov

    return sample_mixands(kept, first, second, lambda: laplace(kept.quotient), above, params, rng)


def _igs(first: Mixture, second: Mixture, search: Omega, params: MixtureWepParams, rng: np.random.Generator) -> Result:
    return single_shot_em(search.samples, product(LogMixture.of(first), LogMixture.of(second))), {}


def _em(first: Mixture, second: Mixture, search: Omega, params: MixtureWepParams, rng: np.random.Generator) -> Result:
    learned = weighted_em(search.samples, params.learned_count(first, second), rng)
    return learned.mixture, {"converged": search.converged & learned.converged}


def _foci(first: Mixture, second: Mixture, search: Omega, params: MixtureWepParams, rng: np.random.Generator) -> Result:
    return first_order(first, second, search.omega), {}


def _pcci(first: Mixture, second: Mixture, search: Omega, params: MixtureWepParams, rng: np.random.Generator) -> Result:
    """Intersect each pair of components by itself, weights as in (17) with the exponents of the pair."""
    pairs = Mixture(*(_pairs(a, b) for a, b in zip(_fields(first), _fields(second), strict=True)))
    rule = covariance_intersection.RULE
    fused = rule.fuse(SourceTracks(pairs.mean, pairs.cov), rule.params())
    assert fused.weights is not None
    log_weight = (fused.weights * np.where(fused.weights > 0.0, log_of(pairs.weight), 0.0)).sum(-1)
    # A component without weight has none in any pair, also where its exponent is 0.
    log_weight = np.where((pairs.weight > 0.0).all(-1), log_weight, -np.inf)
    info = {"converged": fused.info["converged"].all(-1), "iterations": fused.info["iterations"].sum(-1)}
    info["omega_error"] = np.zeros(info["converged"].shape)
    return Mixture(normalised(log_weight), fused.mean, fused.cov), info


def _fields(mixture: Mixture) -> tuple[tuple[Array, int], ...]:
    """List the arrays with the number of axes that follow the components'."""
    return (mixture.weight, 0), (mixture.mean, 1), (mixture.cov, 2)


def _pairs(first: tuple[Array, int], second: tuple[Array, int]) -> Array:
    """Stack all pairs of components: (..., C1, ...) and (..., C2, ...) -> (..., C1 C2, 2, ...)."""
    (one, tail), (other, _) = first, second
    one, other = np.expand_dims(one, -tail - 1), np.expand_dims(other, -tail - 2)
    both = np.stack(np.broadcast_arrays(one, other), -tail - 1)
    lead, (count1, count2) = both.shape[: -tail - 3], both.shape[-tail - 3 : -tail - 1]
    return both.reshape(*lead, count1 * count2, *both.shape[len(lead) + 2 :])


METHODS: dict[str, Method] = {"dls": _dls, "igs": _igs, "is_wem": _em, "foci": _foci, "pcci": _pcci}


EXAMPLES = (
    {"mixand_samples": 400, "samples": 4000},
    {"method": "igs", "samples": 4000},
    {"mixand_samples": 400, **GIVEN},
    {"method": "foci", "criterion": "minimax_information_loss", "samples": 4000},
    {"method": "pcci"},
)

RULE = Rule(
    key="mixture_wep",
    title="Weighted exponential product of mixtures",
    fuse=fuse,
    params=MixtureWepParams,
    family="mixture",
    arity="pairwise",
    guarantee="none",
    caveat="one component at given weights: covariance intersection; not known for mixtures; naive_bayes double counts",
    source="Ahmed (7)-(11), (14)-(17), (23)-(25), Algorithms 1, 2, 3, 5",
    cost="K C^2 S n^2 for C components a source and S samples a mixand",
    order_matters=True,
    optional=("seed",),
    example=Example(EXAMPLES, idempotent=True, monte_carlo=0.3),
)
