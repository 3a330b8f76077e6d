"""Approximate geometric average of Gaussian mixtures: the densities to be localised by all sources at once."""

from __future__ import annotations

from track_fusion.rules.base import Example, FusedTracks, Rule, SourceTracks
from track_fusion.rules.shared.mixtures import AverageParams, fused_tracks, geometric_average
from track_fusion.rules.shared.weights import GIVEN


def fuse(tracks: SourceTracks, params: AverageParams) -> FusedTracks:
    """Fuse K Gaussian mixtures by their geometric average, the power of each component by component.

    Assumes that the components of one mixture are far apart: cross-products in its power are neglected.

    Parameters
    ----------
    tracks : SourceTracks    mixture (..., K, C), or Gaussian tracks; each is normalised first
    params : AverageParams

    Returns
    -------
    FusedTracks    mixture of C^K components, or fewer by `max_components`; mean (..., n) and cov (..., n, n)
                   are its moments; weights (..., K)

    Raises
    ------
    ValueError     given weights do not fit, or a component has no covariance

    Notes          One component: covariance intersection at these weights. Else no guarantee: two copies of a
                   consistent track with components N(+-sqrt 2, 1), whose error has variance 3, claim 2.462, as
                   pairs of unlike components add a false mode between the two. A target that one source
                   misses almost vanishes. Where the number of components is reduced, order matters.
                   O(C^K n^3).
    References     T. Li et al., Second-order statistics analysis and comparison between arithmetic and
                   geometric average fusion, 2019, eqs. (49)-(51).
    """
    weights = params.shares(tracks)
    return fused_tracks(geometric_average(tracks, weights, params), weights)


REDUCED = {"max_components": 2}

RULE = Rule(
    key="mixture_geometric",
    title="Geometric average of mixtures",
    fuse=fuse,
    params=AverageParams,
    family="mixture",
    arity="n_ary",
    guarantee="none",
    caveat="one component: covariance intersection; for several the power is an approximation",
    source="Li 2019 (49)-(51)",
    cost="C^K n^3 for C components a source",
    order_matters="where the number of components is reduced on the way",
    example=Example(({}, GIVEN, REDUCED), ordered=(REDUCED,), idempotent=False),
)
