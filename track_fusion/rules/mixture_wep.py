"""Weighted exponential product of Gaussian mixtures: Chernoff fusion, for unknown common information."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.gaussian import weighted_product
from track_fusion.densities.log_domain import log_of, log_sum_exp, normalised
from track_fusion.densities.mixture.algebra import LogMixture, first_order, product
from track_fusion.densities.mixture.exponent import PROPOSAL_OMEGA, Omega, optimise_omega, overlap_proposal
from track_fusion.densities.mixture.mixture import Mixture, chosen, same, stacked
from track_fusion.densities.mixture.proposals import prune_mixands
from track_fusion.densities.mixture.quotient import Laplace, laplace, wep_bound, wep_quotient
from track_fusion.densities.mixture.sampling import single_shot_em, weighted_em
from track_fusion.linalg import Array
from track_fusion.params import param
from track_fusion.rules import covariance_intersection
from track_fusion.rules.base import FusedTracks, Rule, SourceTracks, check_weights
from track_fusion.rules.mixture_common import (
    Generators,
    Step,
    either,
    fold_mixtures,
    fuse_sampled,
    has_one_component,
    heaviest,
)
from track_fusion.rules.mixture_quotients import QuotientParams, sample_mixands
from track_fusion.rules.pairwise import share_of_first
from track_fusion.weights.pooling import chernoff_weights, minimax_weights


@dataclasses.dataclass(frozen=True)
class MixtureWepParams(QuotientParams):
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
    weights: tuple[float, ...] = param(
        (), "fusion weights for criterion given, one a source, sum 1", low=0.0, high=1.0, kind=float
    )
    omega_proposal: str = param(
        "overlap",
        "what the search for omega, igs and is_wem sample from: products of powers of components, weighted by their "
        "overlap, or without regard to it, as foci and the paper have it (first_order)",
        choices=("overlap", "first_order"),
    )


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
    FusedTracks    mixture; mean (..., n) and cov (..., n, n) are its moments; weights (..., K); info converged,
                   iterations, ess (least share of samples that are effective), log_eta (log of the integral of the
                   product: very low for disjoint densities), pruned (bound on the share of weight not sampled)

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
    if params.weights and params.criterion != "given":
        raise ValueError(f"The 'weights' parameter needs criterion 'given'. Got criterion {params.criterion!r}.")
    given = check_weights(params.weights, tracks.count) if params.criterion == "given" else None
    start = {"converged": True, "iterations": 0, "ess": 1.0, "log_eta": 0.0, "pruned": 0.0}

    def fuse_piece(piece: SourceTracks, rngs: Generators) -> FusedTracks:
        def step(first: Mixture, second: Mixture, k: int) -> Step:
            share = None if given is None else share_of_first(given, k)
            return _fuse_pair(first, second, params, rngs[k - 1], share)

        return fold_mixtures(piece, params, step, start)

    return fuse_sampled(tracks, params.points(tracks), fuse_piece)


def _fuse_pair(
    first: Mixture, second: Mixture, params: MixtureWepParams, rng: np.random.Generator, share: float | None
) -> Step:
    if params.method == "naive_bayes":
        return _multiply(first, second)
    if params.method == "pcci":
        return _sample_pair(first, second, params, rng, share)
    single = has_one_component(first) & has_one_component(second)
    if single.all():
        return _fuse_gaussians(heaviest(first), heaviest(second), params.criterion, share)
    sampled = _sample_pair(first, second, params, rng, share)
    if not single.any():
        return sampled
    return either(single, _fuse_gaussians(heaviest(first), heaviest(second), params.criterion, share), sampled)


def _sample_pair(
    first: Mixture, second: Mixture, params: MixtureWepParams, rng: np.random.Generator, share: float | None
) -> Step:
    lead = first.weight.shape[:-1]
    given = None if share is None else np.full(lead, share)
    proposal = PROPOSALS[params.omega_proposal](first, second)
    found = optimise_omega(first, second, rng, params.samples, params.criterion, given, proposal)
    info: dict[str, NDArray[Any]] = {
        "converged": found.converged,
        "iterations": found.iterations,
        "ess": found.samples.ess / params.samples,
        "log_eta": found.samples.log_eta,
        "pruned": np.zeros(lead),
    }
    # At the ends, and of equal sources, one source is the answer; 1/2 keeps the rest finite there.
    ends = (found.omega == 0.0) | (found.omega == 1.0) | same(first, second)
    inside = found._replace(omega=np.where(ends, 0.5, found.omega))
    fused, more = METHODS[params.method](first, second, inside, params, rng)
    omega = None if params.method == "pcci" else found.omega
    known = {"ess": np.ones(lead), "log_eta": np.zeros(lead), "pruned": np.zeros(lead)}
    answer = Step(chosen(found.omega > 0.0, first, second), omega, info | known)
    return either(ends, answer, Step(fused, omega, info | more))


#: What Algorithm 1 draws from.
PROPOSALS: dict[str, Callable[[Mixture, Mixture], Mixture]] = {
    "overlap": overlap_proposal,
    "first_order": lambda first, second: first_order(first, second, np.full(first.weight.shape[:-1], PROPOSAL_OMEGA)),
}


def _multiply(first: Mixture, second: Mixture) -> Step:
    """Fuse naively: nothing is searched or sampled."""
    whole = product(LogMixture.of(first), LogMixture.of(second))
    lead = whole.log_weight.shape[:-1]
    info: dict[str, NDArray[Any]] = {
        "converged": np.ones(lead, bool), "iterations": np.zeros(lead, np.intp), "ess": np.ones(lead),
        "log_eta": log_sum_exp(whole.log_weight), "pruned": np.zeros(lead),
    }  # fmt: skip
    return Step(whole.normalised, None, info)


def _fuse_gaussians(first: Mixture, second: Mixture, criterion: str, share: float | None) -> Step:
    """Fuse single components (...) exactly: the geometric average of Gaussians, without sampling."""
    lead, n = first.weight.shape[:-1], first.mean.shape[-1]
    both = stacked(first, second)
    mean, cov = both.mean[..., 0, :], both.cov[..., 0, :, :]
    converged, iterations = np.ones(lead, bool), np.zeros(lead, np.intp)
    if share is None:
        search = chernoff_weights if criterion == "chernoff" else minimax_weights
        size = math.prod(lead)
        found = search(mean.reshape(size, 2, n), cov.reshape(size, 2, n, n))
        omega = found.weights[:, 0].reshape(lead)
        converged, iterations = found.converged.reshape(lead), found.iterations.reshape(lead)
    else:
        omega = np.full(lead, share)
    fused = weighted_product(mean, cov, np.stack([omega, 1.0 - omega], -1))
    inside = (omega > 0.0) & (omega < 1.0)
    middle = np.where(inside, omega, 0.5)
    integral = wep_bound(first, second, middle)[..., 0]
    info = {
        "converged": converged,
        "iterations": iterations,
        "ess": np.ones(lead),
        "log_eta": np.where(inside, integral, 0.0),
        "pruned": np.zeros(lead),
    }
    return Step(Mixture(np.ones((*lead, 1)), fused[0][..., None, :], fused[1][..., None, :, :]), omega, info)


Result = tuple[Mixture, dict[str, NDArray[Any]]]
Method = Callable[[Mixture, Mixture, Omega, MixtureWepParams, np.random.Generator], Result]


def _dls(first: Mixture, second: Mixture, found: Omega, params: MixtureWepParams, rng: np.random.Generator) -> Result:
    bound = wep_bound(first, second, found.omega)
    # The mixands sum to the whole integral, of which Algorithm 1 has an estimate: one is no less than the mean.
    likely = np.broadcast_to((found.samples.log_eta - np.log(bound.shape[-1]))[..., None], bound.shape)
    kept = prune_mixands(wep_quotient(first, second, found.omega), bound, likely, params.prune_nats)

    def wide(near: Laplace) -> Array:
        above = first_order(first, second, found.omega).cov
        return np.take_along_axis(above, kept.order[..., None, None], -3)

    return sample_mixands(kept, first, second, lambda: laplace(kept.quotient), wide, params, rng)


def _igs(first: Mixture, second: Mixture, found: Omega, params: MixtureWepParams, rng: np.random.Generator) -> Result:
    return single_shot_em(found.samples, product(LogMixture.of(first), LogMixture.of(second))), {}


def _em(first: Mixture, second: Mixture, found: Omega, params: MixtureWepParams, rng: np.random.Generator) -> Result:
    learned = weighted_em(found.samples, params.learned_count(first, second), rng)
    return learned.mixture, {"converged": found.converged & learned.converged}


def _foci(first: Mixture, second: Mixture, found: Omega, params: MixtureWepParams, rng: np.random.Generator) -> Result:
    return first_order(first, second, found.omega), {}


def _pcci(first: Mixture, second: Mixture, found: Omega, params: MixtureWepParams, rng: np.random.Generator) -> Result:
    """Intersect each pair of components by itself, weights as in (17) with the exponents of the pair."""
    pairs = Mixture(*(_pairs(a, b) for a, b in zip(_fields(first), _fields(second), strict=True)))
    rule = covariance_intersection.RULE
    fused = rule.fuse(SourceTracks(pairs.mean, pairs.cov), rule.params())
    assert fused.weights is not None
    log_weight = (fused.weights * np.where(fused.weights > 0.0, log_of(pairs.weight), 0.0)).sum(-1)
    info = {"converged": fused.info["converged"].all(-1), "iterations": fused.info["iterations"].sum(-1)}
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
)
