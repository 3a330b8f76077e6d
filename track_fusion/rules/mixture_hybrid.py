"""Hybrid fusion of PHDs: how many targets by the arithmetic, where they are by the geometric average."""

from __future__ import annotations

from track_fusion.rules.base import Example, FusedTracks, Mixture, Rule, SourceTracks
from track_fusion.rules.shared.mixtures import AverageParams, fused_tracks, geometric_average, source_mixtures
from track_fusion.rules.shared.weights import GIVEN


def fuse(tracks: SourceTracks, params: AverageParams) -> FusedTracks:
    """Fuse K un-normalised mixtures (PHDs): arithmetic average of cardinality, geometric of localisation.

    Parameters
    ----------
    tracks : SourceTracks    mixture (..., K, C), whose weights sum to the expected number of targets
    params : AverageParams

    Returns
    -------
    FusedTracks    mixture of C^K components, or fewer by `max_components`, whose weights sum to the weighted
                   mean of the sources' sums; mean (..., n) and cov (..., n, n) are its moments, as if
                   normalised; weights (..., K)

    Raises
    ------
    ValueError     given weights do not fit, or a component has no covariance

    Notes          No guarantee; the localisation is that of mixture_geometric: two copies of a track with
                   components N(+-sqrt 2, 1), whose error has variance 3, claim 2.462. A target that
                   one source misses almost vanishes, and the others receive its weight. O(C^K n^3).
    References     T. Li et al., Second-order statistics analysis and comparison between arithmetic and
                   geometric average fusion, 2019, section 5.2, eqs. (49)-(51).
    """
    weights = params.shares(tracks)
    where = geometric_average(tracks, weights, params)
    number = (weights * source_mixtures(tracks).weight.sum(-1)).sum(-1)
    return fused_tracks(Mixture(number[..., None] * where.weight, where.mean, where.cov), weights)


REDUCED = {"max_components": 2}

RULE = Rule(
    key="mixture_hybrid",
    title="Hybrid average of PHDs",
    fuse=fuse,
    params=AverageParams,
    family="mixture",
    arity="n_ary",
    guarantee="none",
    caveat="one component: covariance intersection; keeps the mean number of targets, not every target",
    source="Li 2019 section 5.2, (49)-(51)",
    cost="C^K n^3 for C components a source",
    order_matters="where the number of components is reduced on the way",
    takes_phds=True,
    example=Example(({}, GIVEN, REDUCED), ordered=(REDUCED,), idempotent=False),
)
