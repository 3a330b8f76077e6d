"""Harmonic mean density: naive fusion over what the tracks may have in common."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.harmonic import HarmonicMean
from track_fusion.densities.mixture.mixture import Mixture, gaussian, moments, stacked
from track_fusion.linalg import Array, matvec, outer, transpose
from track_fusion.params import param
from track_fusion.rules.base import Example, FusedTracks, Rule, SourceTracks
from track_fusion.rules.shared.folding import PairFusion, Step, fold, fold_mixtures, share_of_first
from track_fusion.rules.shared.mixtures import fused_tracks
from track_fusion.rules.shared.sampled_means import MeanSamplingParams, sampled_mean
from track_fusion.rules.shared.sampling import Generators, fuse_sampled
from track_fusion.rules.shared.weights import GIVEN, TRACE, WeightParams, diagnostics
from track_fusion.solvers.optimise import Derivatives, Solution, minimise_on_interval
from track_fusion.solvers.pair import Pair
from track_fusion.weights.merging import merging_weights, merging_weights_by_trace, pair_derivatives


@dataclasses.dataclass(frozen=True)
class HarmonicMeanParams(WeightParams, MeanSamplingParams):
    """How the harmonic mean is evaluated, and how its weights omega are chosen; components count for sampling only."""

    method: str = param(
        "gaussian",
        "gaussian: the mixture in the denominator replaced by its Gaussian (HMD-GA); sampling: the density itself, by "
        "weighted samples (HMD-S), of mixtures too",
        choices=("gaussian", "sampling"),
    )
    combine: str = param(
        "joint",
        "more than two tracks: the harmonic mean of all (joint), or of the first two, then of that and the third, and "
        "so on, as the paper has it (fold)",
        choices=("joint", "fold"),
    )
    criterion: str = param(
        "det",
        "what of the inverse covariance of the denominator the weights minimise, eq. (77): its determinant (does not "
        "depend on units), its trace (does), or nothing (given by 'weights')",
        choices=("det", "trace", "given"),
    )


def fuse(tracks: SourceTracks, params: HarmonicMeanParams) -> FusedTracks:
    """Fuse K Gaussian tracks by the harmonic mean of their densities.

    f is proportional to 1 / sum of w_i / p_i, for two p1 p2 / ((1 - w) p1 + w p2). HMD-GA puts N(m, M) with the
    moments of the mixture in place of the denominator: P^-1 = P1^-1 + P2^-1 - M^-1; of more tracks the mixture is that
    of the products of all but one. HMD-S has the moments of weighted samples of f. Not guaranteed conservative.

    Parameters
    ----------
    tracks : SourceTracks    mean (..., K, n), cov (..., K, n, n); for method sampling the mixtures (..., K, C), if
                             there are any, normalised first, and extras["seed"]: int or Generator, 0 if absent
    params : HarmonicMeanParams

    Returns
    -------
    FusedTracks    mean (..., n), cov (..., n, n), weights (..., K), info converged, iterations; by sampling also the
                   mixture for mixtures, info ess (least share of samples that are effective; where it is no more
                   than 1 %, converged is false) and log_eta (log of the integral of f, very low for disjoint densities)

    Raises
    ------
    ValueError     given weights do not fit, or a component of a mixture has no covariance
    LinAlgError    a covariance is singular

    Notes          Variances 1 and 10 whose errors have the correlation .9 give a mean squared error over the claim of
                   1.09 at the weights (77); 1.16 at w = 1/2 and correlation .99. For equal means it is
                   inverse covariance intersection at the mirrored weights. K > 2 folded: the order matters, since (14)
                   is exact only before normalisation; of given weights track k meets the fusion of
                   those before it with its share of their sum. Jointly the weights sought are those of the
                   mixture in the denominator, convex for either criterion, and those told are omega. O(K n^3), by S
                   samples O(K C S n^2). Sampled moments vary with the seed by about a standard deviation over the
                   root of the number of effective samples; where 1 % or less are, HMD-GA of the moments takes
                   their place, its covariance times `inflation`.
    References     N. Sharma et al., Harmonic Mean Density Fusion in Distributed Tracking: Performance and
                   Comparison, eqs. (11), (19), (31)-(35), (77); by sampling (66), (69)-(73).
    """
    given = params.given(tracks.count)
    jointly = params.combine == "joint" and tracks.count > 2
    if params.method == "sampling":
        sample = _sample_all if jointly else _sample_pairs
        return fuse_sampled(
            tracks, tracks.count * params.samples, lambda piece, rngs: sample(piece, params, given, rngs)
        )
    if jointly:
        harmonic = HarmonicMean.of(*tracks.flat)
        omega, search = _weighed(harmonic, params.criterion, given)
        return tracks.fused(*harmonic.at(search.weights), omega, info=diagnostics(search))

    def kernel(x1: Array, p1: Array, x2: Array, p2: Array, share: float | None) -> PairFusion:
        pair = Pair.of(p1, p2)
        difference = pair.coordinates(x1 - x2)
        return _fuse_at(pair, x2, difference, _search(pair, difference, params.criterion, share))

    return fold(tracks, kernel, given)


def _sample_all(tracks: SourceTracks, params: HarmonicMeanParams, given: Array | None, rngs: Generators) -> FusedTracks:
    """Fuse all sources at once by HMD-S."""
    step = _sampled(params.sources(tracks).normalised, params, given, rngs[0])
    fused = fused_tracks(step.mixture, step.omega, step.info)
    return fused if tracks.mixture is not None else dataclasses.replace(fused, mixture=None)


def _sample_pairs(
    tracks: SourceTracks, params: HarmonicMeanParams, given: Array | None, rngs: Generators
) -> FusedTracks:
    """Fuse source by source by HMD-S."""

    def step(first: Mixture, second: Mixture, k: int) -> Step:
        share = None if given is None else share_of_first(given, k)
        pair = None if share is None else np.array([share, 1.0 - share])
        fused = _sampled(stacked(first, second), params, pair, rngs[k - 1])
        return fused._replace(omega=None if fused.omega is None else fused.omega[..., 0])

    fused = fold_mixtures(tracks, params, step, ("converged", "iterations", "ess", "log_eta"))
    return fused if tracks.mixture is not None else dataclasses.replace(fused, mixture=None)


def _sampled(parts: Mixture, params: HarmonicMeanParams, given: Array | None, rng: np.random.Generator) -> Step:
    """Fuse K densities (..., K, C) by HMD-S; the weights (77) are those of the Gaussians with their moments."""
    lead, (count, n) = parts.mean.shape[:-3], (parts.mean.shape[-3], parts.mean.shape[-1])
    mean, cov = moments(parts)
    harmonic = HarmonicMean.of(mean.reshape(-1, count, n), cov.reshape(-1, count, n, n))
    omega, search = _weighed(harmonic, params.criterion, given)
    omega = omega.reshape(*lead, count)

    def closed() -> Mixture:
        fused_mean, fused_cov = harmonic.at(search.weights)
        return gaussian(fused_mean.reshape(*lead, n), params.inflation * fused_cov.reshape(*lead, n, n))

    mixture, info = sampled_mean(parts, omega, "harmonic", params, rng, closed)
    converged = info["converged"] & search.converged.reshape(lead)
    return Step(mixture, omega, {**info, "converged": converged, "iterations": search.iterations.reshape(lead)})


def _weighed(harmonic: HarmonicMean, criterion: str, given: Array | None) -> tuple[Array, Solution]:
    """Weights omega (B, K), given or by (77), and the search for those of the mixture in the denominator."""
    batch, count, n = harmonic.means.shape
    if given is not None:
        omega = np.broadcast_to(given, (batch, count))
        return omega, Solution.known(harmonic.shares(omega))
    if criterion == "trace":
        lower = harmonic.lower[:, None]
        covs = lower @ harmonic.others @ transpose(lower)
        search = merging_weights_by_trace(matvec(lower, harmonic.means), covs)
    else:
        search = merging_weights(harmonic.means, harmonic.others, np.zeros((batch, count)))
    return harmonic.weights(search.weights), search


def _search(pair: Pair, difference: Array, criterion: str, share: float | None) -> Solution:
    """Weights of track 1, given or by (77): (1 - w) P1 + w P2 + w (1 - w) d d' shall be large."""
    count = difference.shape[1]
    if share is not None:
        return Solution.known(np.full(count, share))
    if criterion == "trace":
        return minimise_on_interval(_trace_derivatives(pair, difference), count)
    mirrored = minimise_on_interval(pair_derivatives(pair, difference, np.zeros(count)), count)
    return dataclasses.replace(mirrored, weights=1.0 - mirrored.weights)


def _trace_derivatives(pair: Pair, difference: Array) -> Derivatives:
    """Derivatives over the weight of track 1 of tr M^-1, M the covariance of the denominator."""
    first, change, offset = (np.ascontiguousarray(x.T) for x in (pair.first, pair.contrast, difference))
    units = pair.inverse @ transpose(pair.inverse)

    def derivatives(w: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        w = w[:, None]
        unit, a, e, d = units[rows], change[rows], offset[rows], first[rows] + w * change[rows]
        share, v = e / d, w * (1.0 - w)
        pull = share / (1.0 + v * (e * share).sum(1, keepdims=True))  # M^-1 e
        inverse = (1.0 / d)[:, :, None] * np.eye(e.shape[1]) - v[..., None] * share[:, :, None] * pull[:, None, :]
        step = inverse * a[:, None, :] + (1.0 - 2.0 * w)[..., None] * pull[:, :, None] * e[:, None, :]  # M^-1 M'
        image = step @ inverse
        bend = (unit * (step @ image)).sum((1, 2)) + (pull * matvec(unit, pull)).sum(1)
        return -(unit * image).sum((1, 2)), 2.0 * bend

    return derivatives


def _fuse_at(pair: Pair, x2: Array, e: Array, search: Solution) -> PairFusion:
    """Fuse at weights where both covariances are diagonal and P1 + P2 = 1; e (n, B) is the difference of the means.

    With D = (1 - w) P1 + w P2, S = D - P1 P2 = (1 - w) P1^2 + w P2^2, v = w (1 - w), the matrix
    P1^-1 + P2^-1 - (D + v e e')^-1 is diagonal with one of rank one, so that its inverse is F - c g g'.
    """
    p, q, w = pair.first, pair.second, search.weights
    v = w * (1.0 - w)
    whole, rest = (1.0 - w) * p + w * q, (1.0 - w) * p * p + w * q * q
    spread = v * (e * e / whole).sum(0)
    spread /= 1.0 + spread
    g = p * q * e / rest
    c = v / (1.0 + v * (e * e / rest).sum(0))
    # F b and g' b, b = P1^-1 e - (1 - w) M^-1 e: what is subtracted is, worked out, a sum.
    force = w * q * q + (1.0 - w) * p * q * spread
    pull = e * force / rest - c * g * (e * e * force / (rest * whole)).sum(0)
    column = pair.from_coordinates(g)
    cov = pair.rebuild(p * q * whole / rest) - c[:, None, None] * outer(column)
    return PairFusion(x2 + pair.from_coordinates(pull), cov, search)


FOLD = {"combine": "fold"}

RULE = Rule(
    key="harmonic_mean",
    title="Harmonic mean density",
    fuse=fuse,
    params=HarmonicMeanParams,
    family="gaussian",
    arity="n_ary",
    guarantee="none",
    caveat="mean squared errors of up to 1.16 times the claim in the scalar example",
    source="Sharma (31)-(35), (66), (69)-(73), (77)",
    cost="K n^3; K S n^2 by S samples",
    order_matters="with combine fold",
    optional=("seed",),
    optional_when=(("seed", "method", "sampling"),),
    affine_equivariant="not with criterion trace: the trace depends on the units of the axes",
    example=Example(
        ({}, TRACE, GIVEN, FOLD, {"method": "sampling", "samples": 5000}),
        not_equivariant=(TRACE,), ordered=(FOLD,), idempotent=True, monte_carlo=0.15,
    ),
)  # fmt: skip
