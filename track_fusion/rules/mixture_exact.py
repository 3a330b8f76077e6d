"""Exact fusion of Gaussian mixtures whose common information is known: the product over what both share."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.log_domain import log_sum_exp, normalised
from track_fusion.densities.mixture.mixture import Factored, Mixture, chosen, moments, same, sample, take_components
from track_fusion.densities.mixture.proposals import (
    MOST_SPREAD,
    indirect_global_sampling,
    laplace_proposal,
    prune_mixands,
)
from track_fusion.densities.mixture.quotient import (
    Bound,
    Laplace,
    Quotient,
    exact_bound,
    exact_quotient,
    laplace,
    moment_matched,
    not_integrable,
)
from track_fusion.densities.mixture.sampling import Weighted, weighted_em
from track_fusion.linalg import Array, asymmetric, is_positive_definite
from track_fusion.params import param
from track_fusion.rules.base import Example, FusedTracks, Rule, SourceTracks
from track_fusion.rules.shared.folding import Step, fold_mixtures
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


@dataclasses.dataclass(frozen=True)
class MixtureExactParams(QuotientParams):
    """How the quotient becomes a mixture."""

    method: str = param(
        "dls",
        "dls: sample each mixand, igs: sample the whole and share out, mmgd: replace the common information by its "
        "Gaussian, laplace: Gaussians at the modes, common_proposal: sample the common information and fit by "
        "expectation maximisation, naive_bayes: leave the common information in",
        choices=("dls", "igs", "mmgd", "laplace", "common_proposal", "naive_bayes"),
    )
    inflation: float = param(2.0, "factor on the covariances that igs samples with", low=1.0)
    not_integrable: str = param(
        "refuse", "pairs of components whose quotient has no integral: refuse the fusion, or skip these pairs",
        choices=("refuse", "skip"),
    )  # fmt: skip


def fuse(tracks: SourceTracks, params: MixtureExactParams) -> FusedTracks:
    """Fuse mixtures exactly by p1 p2 / p_c, p_c the information that they share, in the order of the sources.

    Assumes that the sources are independent but for the common information given.

    Parameters
    ----------
    tracks : SourceTracks    mixture (..., K, C), or Gaussian tracks; each normalised first. extras["common"]: a Mixture
                             (..., T) that every source contains, or a sequence of K - 1: what source k + 1
                             shares with the fusion of those before. extras["seed"]: int or Generator, 0 if absent
    params : MixtureExactParams

    Returns
    -------
    FusedTracks    mixture; mean (..., n) and cov (..., n, n) are its moments; info converged, ess (least share of
                   samples that are effective), log_eta (log of the integral of the quotient: very low for
                   disjoint densities), pruned (bound on the share of weight not sampled), skipped (pairs left out)

    Raises
    ------
    ValueError     'common' does not fit, a component has no covariance, a quotient has no integral, or (method
                   common_proposal) so few samples have weight that nothing can be learned from them

    Notes          One component of any weight each: the quotient in closed form, without sampling. A source that
                   equals the common information adds nothing, exactly. Else sampled: moments vary with the seed by
                   about a standard deviation over the root of the number of effective samples. No guarantee if the
                   sources share more than is given: two copies of N(x, P) with common information N(x, 2 P)
                   claim P / 1.5 with an error of P. O(C^2 S T n^2) for S samples a mixand.
    References     N. R. Ahmed, Decentralized Gaussian Mixture Fusion through Unified Quotient Approximations,
                   eqs. (6), (13), (22), (26)-(37), (46)-(56), Algorithms 2 to 5.
    """
    common_information(tracks)  # says what is wrong before the batch is cut

    def fuse_piece(piece: SourceTracks, rngs: Generators) -> FusedTracks:
        shared = common_information(piece)

        def step(first: Mixture, second: Mixture, k: int) -> Step:
            return _fuse_pair(first, second, shared[k - 1], params, rngs[k - 1])

        return fold_mixtures(piece, params, step, ("converged", "ess", "log_eta", "pruned", "skipped"))

    return fuse_sampled(tracks, params.points(tracks), fuse_piece)


def common_information(tracks: SourceTracks) -> list[Mixture]:
    """Read extras["common"]: for each of K - 1 fusions a normalised mixture over the tracks' leading axes.

    Raises
    ------
    ValueError    not a Mixture or K - 1 of them, or its shape, weights or covariances do not fit
    """
    given = tracks.extras["common"]
    steps = tracks.count - 1
    many = list(given) if isinstance(given, Sequence) else [given] * steps
    if len(many) != steps or not all(isinstance(m, Mixture) for m in many):
        raise ValueError(f"The extra 'common' must be a Mixture, or a sequence of {steps}. Got {type(given).__name__}.")
    lead, n = tracks.mean.shape[:-2], tracks.mean.shape[-1]
    return [_checked(m, lead, n) for m in many]


def _checked(common: Mixture, lead: tuple[int, ...], n: int) -> Mixture:
    (*own, count), wanted = common.weight.shape, common.mean.shape[-1:]
    if common.mean.shape != (*own, count, n) or common.cov.shape != (*own, count, n, n):
        raise ValueError(
            f"The extra 'common' must have a mean (..., T, {n}) and a cov (..., T, {n}, {n}) for weights (..., T). "
            f"Got {common.mean.shape} and {common.cov.shape} for {common.weight.shape}, n = {wanted}."
        )
    if not (np.isfinite(common.weight).all() and (common.weight >= 0.0).all() and (common.weight.sum(-1) > 0.0).all()):
        raise ValueError("The extra 'common' must have weights that are non-negative and not all 0.")
    if not (np.isfinite(common.mean).all() and np.isfinite(common.cov).all()):
        raise ValueError("The extra 'common' must be finite.")
    if not is_positive_definite(common.cov).all():
        raise ValueError("The extra 'common' must have positive definite covariances.")
    if asymmetric(common.cov):
        raise ValueError("The extra 'common' must have symmetric covariances.")
    return common.normalised.broadcast(lead)


def _fuse_pair(
    first: Mixture, second: Mixture, common: Mixture, params: MixtureExactParams, rng: np.random.Generator
) -> Step:
    if params.method == "naive_bayes":
        return multiply(first, second)
    silent = same(first, common), same(second, common)
    known = silent[0] | silent[1]
    # A source that says no more than what both share gives the other, whatever the quotient.
    answer = Step(chosen(silent[0], second, first), None, {})
    single = has_one_component(first) & has_one_component(second) & has_one_component(common)

    def by(method: str, problem: Problem) -> Step:
        mixture, info = METHODS[method](problem, params, rng)
        return Step(mixture, None, info)

    ones = heaviest(first), heaviest(second), heaviest(common)
    fused = closed_form_where(
        single,
        lambda: by("mmgd", Problem.of(*ones, known | ~single)),
        lambda: by(params.method, Problem.of(first, second, common, known)),
    )
    return either(known, answer, fused)


@dataclasses.dataclass(frozen=True)
class Problem:
    """One fusion of two mixtures (...); `exempt` (...) tells where the result is known without a quotient."""

    quotient: Quotient
    first: Mixture
    second: Mixture
    common: Mixture
    exempt: NDArray[np.bool_]

    @classmethod
    def of(cls, first: Mixture, second: Mixture, common: Mixture, exempt: NDArray[np.bool_]) -> Problem:
        """State the quotient."""
        return cls(exact_quotient(first, second, common), first, second, common, exempt)

    def admitted(self, bad: NDArray[np.bool_], params: MixtureExactParams) -> tuple[Quotient, NDArray[np.intp]]:
        """Leave out mixands `bad` (..., M) that have no integral, or refuse; return the rest and how many went.

        Raises
        ------
        ValueError    some are to be refused, or none is left
        """
        bad = bad & ~self.exempt[..., None]
        skipped = bad.sum(-1)
        weight = np.where(bad, -np.inf, self.quotient.numerator.log_weight)
        none_left = ~np.isfinite(weight).any(-1) & ~self.exempt
        if (bad.any() and params.not_integrable == "refuse") or none_left.any():
            pairs = np.isfinite(self.quotient.numerator.log_weight).sum()
            raise ValueError(
                f"The quotient by the extra 'common' has no integral for {bad.sum()} of {pairs} pairs of "
                "components: along some direction their product falls no faster than 'common'. "
                "The parameter 'not_integrable' = 'skip' leaves such pairs out, if others remain."
            )
        numerator = self.quotient.numerator._replace(log_weight=weight)
        return dataclasses.replace(self.quotient, numerator=numerator), skipped


Result = tuple[Mixture, dict[str, NDArray[Any]]]
Method = Callable[[Problem, MixtureExactParams, np.random.Generator], Result]


def _prepared(problem: Problem, params: MixtureExactParams) -> tuple[Quotient, Bound, Laplace, dict[str, NDArray[Any]]]:
    """Bound the mixands, see to those without integral, approximate the rest by Laplace."""
    bound = exact_bound(problem.quotient, problem.common)
    bad = not_integrable(problem.quotient, problem.common, bound.sure | problem.exempt[..., None])
    quotient, skipped = problem.admitted(bad, params)
    bound = bound._replace(log_weight=np.where(bad, -np.inf, bound.log_weight))
    return quotient, bound, laplace(quotient), {"skipped": skipped}


def _dls(problem: Problem, params: MixtureExactParams, rng: np.random.Generator) -> Result:
    quotient, bound, modes, info = _prepared(problem, params)
    kept = prune_mixands(quotient, bound.log_weight, modes.log_moment, params.prune_nats)

    def approximate() -> Laplace:
        return Laplace(*(take_components(a, kept.order) for a in modes))

    def wide(near: Laplace) -> Array:
        """Covariances of the Gaussians above the mixands; where there is none, the widest that heavy tails allow."""
        sure = take_components(bound.sure, kept.order)
        return np.where(sure[..., None, None], take_components(bound.cov, kept.order), MOST_SPREAD * near.cov)

    mixture, more = sample_mixands(kept, problem.first, problem.second, approximate, wide, params, rng)
    return mixture, info | more


def _igs(problem: Problem, params: MixtureExactParams, rng: np.random.Generator) -> Result:
    quotient, _, modes, info = _prepared(problem, params)
    proposal = laplace_proposal(modes, params.inflation)
    result = indirect_global_sampling(quotient, proposal, rng, params.samples)
    ess = result.samples.ess / params.samples
    return result.mixture, info | {"ess": ess, "log_eta": result.samples.log_eta}


def _laplace(problem: Problem, params: MixtureExactParams, rng: np.random.Generator) -> Result:
    _, _, modes, info = _prepared(problem, params)
    good = modes.converged | ~np.isfinite(modes.log_moment) | problem.exempt[..., None]
    info |= {"converged": np.asarray(good.all(-1)), "log_eta": log_sum_exp(modes.log_moment)}
    return Mixture(normalised(modes.log_moment), modes.mean, modes.cov), info


def _mmgd(problem: Problem, params: MixtureExactParams, rng: np.random.Generator) -> Result:
    divided, proper = moment_matched(problem.quotient, *moments(problem.common))
    quotient, skipped = problem.admitted(~proper & np.isfinite(divided.log_weight), params)
    weight = np.where(np.isfinite(quotient.numerator.log_weight), divided.log_weight, -np.inf)
    fused = divided._replace(log_weight=weight).normalised
    return fused, {"skipped": skipped, "log_eta": log_sum_exp(weight)}


def _common_proposal(problem: Problem, params: MixtureExactParams, rng: np.random.Generator) -> Result:
    points = sample(problem.common, rng, params.samples).points
    log_first, log_second, log_common = (
        Factored.of(m).log_pdf(points) for m in (problem.first, problem.second, problem.common)
    )
    drawn = Weighted(points, log_first + log_second - 2.0 * log_common)
    learned = weighted_em(drawn, params.learned_count(problem.first, problem.second), rng)
    info = {"converged": learned.converged, "ess": drawn.ess / params.samples, "log_eta": drawn.log_eta}
    return learned.mixture, info


METHODS: dict[str, Method] = {
    "dls": _dls, "igs": _igs, "mmgd": _mmgd, "laplace": _laplace, "common_proposal": _common_proposal,
}  # fmt: skip


RULE = Rule(
    key="mixture_exact",
    title="Exact fusion of mixtures",
    fuse=fuse,
    params=MixtureExactParams,
    family="mixture",
    arity="pairwise",
    guarantee="structural",
    caveat="exact, up to sampling, if the sources are independent but for the common information given; not with "
    "naive_bayes, and roughly with mmgd, laplace and common_proposal",
    source="Ahmed (6), (13), (22), (26)-(37), (46)-(56), Algorithms 2 to 5",
    cost="K C^2 S T n^2 for C components a source, T of the common information and S samples a mixand",
    order_matters=True,
    needs=("common",),
    optional=("seed",),
    example=Example(({"mixand_samples": 400}, {"method": "igs", "samples": 2000}), idempotent=False, monte_carlo=0.3),
)
