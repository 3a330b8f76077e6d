"""Harmonic mean density: naive fusion over the mixture of both tracks."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.mixture.algebra import LogMixture, product
from track_fusion.densities.mixture.mean_density import fit_mean_density, sample_mean_density
from track_fusion.densities.mixture.mixture import Mixture, chosen, moments, same, stacked
from track_fusion.linalg import Array, matvec, outer, transpose
from track_fusion.params import param
from track_fusion.rules.base import Example, FusedTracks, Rule, SourceTracks
from track_fusion.rules.shared.folding import PairFusion, Step, fold, fold_mixtures, share_of_first
from track_fusion.rules.shared.mixtures import ReductionParams
from track_fusion.rules.shared.sampling import Generators, fuse_sampled
from track_fusion.rules.shared.weights import GIVEN, TRACE, WeightParams
from track_fusion.solvers.optimise import Derivatives, Solution, minimise_on_interval
from track_fusion.solvers.pair import Pair
from track_fusion.weights.merging import pair_derivatives


@dataclasses.dataclass(frozen=True)
class HarmonicMeanParams(WeightParams, ReductionParams):
    """How the harmonic mean is evaluated, and how its weights omega are chosen; components count for sampling only."""

    method: str = param(
        "gaussian",
        "gaussian: the mixture in the denominator replaced by its Gaussian (HMD-GA); sampling: the density itself, by "
        "weighted samples (HMD-S), of mixtures too",
        choices=("gaussian", "sampling"),
    )
    criterion: str = param(
        "det",
        "what of the inverse covariance of the denominator the weights minimise, eq. (77): its determinant (does not "
        "depend on units), its trace (does), or nothing (given by 'weights')",
        choices=("det", "trace", "given"),
    )
    samples: int = param(5000, "samples for method sampling, in all", low=10)
    inflation: float = param(
        1.0,
        "alpha: factor on the covariances that method sampling draws from; above 1 it widens the result",
        low=1.0,
    )


def fuse(tracks: SourceTracks, params: HarmonicMeanParams) -> FusedTracks:
    """Fuse pairs of Gaussian tracks by the harmonic mean of their densities, in the order of the sources.

    f is proportional to p1 p2 / ((1 - w) p1 + w p2). HMD-GA puts N(m, M) with the moments of the mixture in place of
    the denominator: P^-1 = P1^-1 + P2^-1 - M^-1. HMD-S has the moments of weighted samples of f. Not guaranteed
    conservative.

    Parameters
    ----------
    tracks : SourceTracks    mean (..., K, n), cov (..., K, n, n); for method sampling the mixtures (..., K, C), if
                             there are any, normalised first, and extras["seed"]: int or Generator, 0 if absent
    params : HarmonicMeanParams

    Returns
    -------
    FusedTracks    mean (..., n), cov (..., n, n), weights (..., K), info converged, iterations; by sampling also the
                   mixture for mixtures, info ess (least share of samples that are effective) and log_eta (log of
                   the integral of f, very low for disjoint densities)

    Raises
    ------
    ValueError     given weights do not fit, or a component of a mixture has no covariance
    LinAlgError    a covariance is singular

    Notes          Variances 1 and 10 whose errors have the correlation .9 give a mean squared error over the claim of
                   1.09 at the weights (77); 1.16 at w = 1/2 and correlation .99. For equal means it is
                   inverse covariance intersection at the mirrored weights. Given weights: track k meets the fusion of
                   those before it with its share of their sum. K > 2: the order matters, since (14) is exact
                   only before normalisation. O(K n^3), by S samples O(K C S n^2). Sampled moments vary with
                   the seed by about a standard deviation over the root of the number of effective samples.
    References     N. Sharma et al., Harmonic Mean Density Fusion in Distributed Tracking: Performance and
                   Comparison, eqs. (11), (31)-(35), (77); by sampling (66), (69)-(73).
    """
    given = params.given(tracks.count)
    if params.method == "sampling":
        return fuse_sampled(
            tracks, tracks.count * params.samples, lambda piece, rngs: _fuse_by_sampling(piece, params, given, rngs)
        )

    def kernel(x1: Array, p1: Array, x2: Array, p2: Array, share: float | None) -> PairFusion:
        pair = Pair.of(p1, p2)
        difference = pair.coordinates(x1 - x2)
        return _fuse_at(pair, x2, difference, _search(pair, difference, params.criterion, share))

    return fold(tracks, kernel, given)


def _fuse_by_sampling(
    tracks: SourceTracks, params: HarmonicMeanParams, given: Array | None, rngs: Generators
) -> FusedTracks:
    """Fuse by HMD-S; the weights (77) are those of the Gaussians with the densities' moments."""

    def step(first: Mixture, second: Mixture, k: int) -> Step:
        lead, parts = first.weight.shape[:-1], stacked(first, second)
        mean, cov = SourceTracks(*moments(parts)).flat
        pair = Pair.of(cov[:, 0], cov[:, 1])
        share = None if given is None else share_of_first(given, k)
        search = _search(pair, pair.coordinates(mean[:, 0] - mean[:, 1]), params.criterion, share)
        omega = search.weights.reshape(lead)
        weights = np.stack([omega, 1.0 - omega], -1)
        drawn = sample_mean_density(parts, weights, "harmonic", rngs[k - 1], params.samples, params.inflation)
        fused = fit_mean_density(drawn, product(LogMixture.of(first), LogMixture.of(second)))
        if params.inflation == 1.0:
            fused = chosen((omega == 1.0) | same(first, second), first, chosen(omega == 0.0, second, fused))
        info = {
            "converged": search.converged.reshape(lead),
            "iterations": search.iterations.reshape(lead),
            "ess": drawn.ess / params.samples,
            "log_eta": drawn.log_eta,
        }
        return Step(fused, omega, info)

    fused = fold_mixtures(tracks, params, step, ("converged", "iterations", "ess", "log_eta"))
    return fused if tracks.mixture is not None else dataclasses.replace(fused, mixture=None)


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


RULE = Rule(
    key="harmonic_mean",
    title="Harmonic mean density",
    fuse=fuse,
    params=HarmonicMeanParams,
    family="gaussian",
    arity="pairwise",
    guarantee="none",
    caveat="mean squared errors of up to 1.16 times the claim in the scalar example",
    source="Sharma (31)-(35), (66), (69)-(73), (77)",
    cost="K n^3; K S n^2 by S samples",
    order_matters=True,
    optional=("seed",),
    optional_when=(("seed", "method", "sampling"),),
    affine_equivariant="not with criterion trace: the trace depends on the units of the axes",
    example=Example(
        ({}, TRACE, GIVEN, {"method": "sampling", "samples": 5000}),
        not_equivariant=(TRACE,), idempotent=True, monte_carlo=0.15,
    ),
)  # fmt: skip
