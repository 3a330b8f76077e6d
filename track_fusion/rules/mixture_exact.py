"""Exact fusion of Gaussian mixtures whose common information is known: the product over what both share."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.log_domain import log_sum_exp, normalised
from track_fusion.densities.mixture.integrability import EFFECTIVE, effective_share, integrability
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
                   disjoint densities), pruned (bound on the share of weight not sampled), skipped (pairs left out),
                   undecided (pairs taken whose integral is neither proved nor refuted), least_difference (the
                   smallest information difference found of those; 1 if there are none)

    Raises
    ------
    ValueError     'common' does not fit, a component has no covariance, a quotient has no integral that can be
                   shown, or (method common_proposal) so few samples have weight that nothing can be learned from them

    Notes          One component of any weight each: the quotient in closed form, without sampling. A source that
                   equals the common information adds nothing, exactly. Else sampled: moments vary with the seed by
                   about a standard deviation over the root of the number of effective samples. A pair of components
                   has an integral if along every direction its product falls faster than some component of
                   'common': proved by one of these or by a convex combination, refuted by a direction, or undecided;
                   then 1000 searches for a direction give the smallest difference, and the pair is taken
                   if more than 1 % of samples from heavy tails count. No guarantee if the
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

        return fold_mixtures(piece, params, step, TOLD)

    return fuse_sampled(tracks, params.points(tracks), fuse_piece)


#: The diagnostics of a fusion.
TOLD = ("converged", "ess", "log_eta", "pruned", "skipped", "undecided", "least_difference")


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

    def admitted(
        self, bad: NDArray[np.bool_], params: MixtureExactParams, why: str
    ) -> tuple[Quotient, NDArray[np.intp]]:
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
                f"components: {why}. "
                "The parameter 'not_integrable' = 'skip' leaves such pairs out, if others remain."
            )
        numerator = self.quotient.numerator._replace(log_weight=weight)
        return dataclasses.replace(self.quotient, numerator=numerator), skipped


Result = tuple[Mixture, dict[str, NDArray[Any]]]
Method = Callable[[Problem, MixtureExactParams, np.random.Generator], Result]


#: Why a quotient of Gaussians has no integral.
NO_FASTER = "along some direction their product falls no faster than 'common'"


def _decided(
    problem: Problem, params: MixtureExactParams, rng: np.random.Generator
) -> tuple[Quotient, Bound, dict[str, NDArray[Any]]]:
    """Bound the mixands, and see to those that have no integral, or none that can be shown."""
    bound = exact_bound(problem.quotient, problem.common)
    verdicts = integrability(problem.quotient, problem.common, bound.sure | problem.exempt[..., None])
    open_ones = ~(verdicts.proved | verdicts.refuted)
    # A generator of its own: what is drawn for these changes no other number.
    diverging = open_ones & ~(effective_share(problem.quotient, open_ones, rng.spawn(1)[0]) > EFFECTIVE)
    bad = verdicts.refuted | diverging
    quotient, skipped = problem.admitted(bad, params, _reason(verdicts.direction[verdicts.refuted], diverging))
    bound = bound._replace(log_weight=np.where(bad, -np.inf, bound.log_weight))
    taken = open_ones & ~diverging
    least = np.where(taken, verdicts.least, 1.0).min(-1, initial=1.0)
    return quotient, bound, {"skipped": skipped, "undecided": taken.sum(-1), "least_difference": least}


def _reason(directions: Array, diverging: NDArray[np.bool_]) -> str:
    """Say why pairs have no integral: the first of the directions (R, n) that refute, or what samples show."""
    reasons = []
    if len(directions):
        shown = ", ".join(f"{x:.3g}" for x in directions[0])
        reasons.append(f"{NO_FASTER}, as along ({shown})")
    if diverging.any():
        reasons.append(
            f"of {diverging.sum()} it is neither proved nor refuted, and no more than {EFFECTIVE:.0%} of samples count"
        )
    return "; ".join(reasons)


def _prepared(
    problem: Problem, params: MixtureExactParams, rng: np.random.Generator
) -> tuple[Quotient, Bound, Laplace, dict[str, NDArray[Any]]]:
    """Bound the mixands, see to those without integral, approximate the rest by Laplace."""
    quotient, bound, info = _decided(problem, params, rng)
    return quotient, bound, laplace(quotient), info


def _dls(problem: Problem, params: MixtureExactParams, rng: np.random.Generator) -> Result:
    quotient, bound, modes, info = _prepared(problem, params, rng)
    kept = prune_mixands(quotient, bound.log_weight, modes.log_moment, params.prune_nats)

    def approximate() -> Laplace:
        return Laplace(*(take_components(a, kept.order) for a in modes))

    def above(near: Laplace) -> tuple[Array, Array]:
        """Gaussians above the mixands; where none is known, the widest that heavy tails allow."""
        sure, mean, cov = (take_components(a, kept.order) for a in (bound.sure, bound.mean, bound.cov))
        mean = np.where(sure[..., None], mean, near.mean)
        return mean, np.where(sure[..., None, None], cov, MOST_SPREAD * near.cov)

    mixture, more = sample_mixands(kept, problem.first, problem.second, approximate, above, params, rng)
    return mixture, info | more


def _igs(problem: Problem, params: MixtureExactParams, rng: np.random.Generator) -> Result:
    quotient, _, modes, info = _prepared(problem, params, rng)
    proposal = laplace_proposal(modes, params.inflation)
    result = indirect_global_sampling(quotient, proposal, rng, params.samples)
    ess = result.samples.ess / params.samples
    return result.mixture, info | {"ess": ess, "log_eta": result.samples.log_eta}


def _laplace(problem: Problem, params: MixtureExactParams, rng: np.random.Generator) -> Result:
    _, _, modes, info = _prepared(problem, params, rng)
    good = modes.converged | ~np.isfinite(modes.log_moment) | problem.exempt[..., None]
    info |= {"converged": np.asarray(good.all(-1)), "log_eta": log_sum_exp(modes.log_moment)}
    return Mixture(normalised(modes.log_moment), modes.mean, modes.cov), info


def _mmgd(problem: Problem, params: MixtureExactParams, rng: np.random.Generator) -> Result:
    divided, proper = moment_matched(problem.quotient, *moments(problem.common))
    bad = ~proper & np.isfinite(divided.log_weight)
    quotient, skipped = problem.admitted(bad, params, NO_FASTER)
    weight = np.where(np.isfinite(quotient.numerator.log_weight), divided.log_weight, -np.inf)
    fused = divided._replace(log_weight=weight).normalised
    return fused, {"skipped": skipped, "log_eta": log_sum_exp(weight)}


def _common_proposal(problem: Problem, params: MixtureExactParams, rng: np.random.Generator) -> Result:
    quotient, _, info = _decided(problem, params, rng)
    points = sample(problem.common, rng, params.samples).points
    above = quotient.numerator.factored.log_pdf(points)
    drawn = Weighted(points, above - 2.0 * Factored.of(problem.common).log_pdf(points))
    learned = weighted_em(drawn, params.learned_count(problem.first, problem.second), rng)
    more = {"converged": learned.converged, "ess": drawn.ess / params.samples, "log_eta": drawn.log_eta}
    return learned.mixture, info | more


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
    guarantee=lambda params: "none" if params.method == "naive_bayes" else "structural",
    caveat="exact, up to sampling, if the sources are independent but for the common information given; not with "
    "naive_bayes, and roughly with mmgd, laplace and common_proposal",
    source="Ahmed (6), (13), (22), (26)-(37), (46)-(56), Algorithms 2 to 5",
    cost="K C^2 S T n^2 for C components a source, T of the common information and S samples a mixand",
    order_matters=True,
    needs=("common",),
    optional=("seed",),
    example=Example(({"mixand_samples": 400}, {"method": "igs", "samples": 2000}), idempotent=False, monte_carlo=0.3),
)
