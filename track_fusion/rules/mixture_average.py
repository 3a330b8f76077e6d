"""Arithmetic average of Gaussian mixtures: the union of their components."""

from __future__ import annotations

from track_fusion.densities.mixture.algebra import average
from track_fusion.rules.base import Example, FusedTracks, Rule, SourceTracks
from track_fusion.rules.shared.mixtures import AverageParams, fused_tracks
from track_fusion.rules.shared.weights import GIVEN


def fuse(tracks: SourceTracks, params: AverageParams) -> FusedTracks:
    """Fuse K Gaussian mixtures by their arithmetic average: f = sum of w_i f_i.

    Conservative if each track is: the weights do not depend on the means. Every mode of every source survives.

    Parameters
    ----------
    tracks : SourceTracks    mixture (..., K, C), or Gaussian tracks; PHDs too: they are not normalised
    params : AverageParams

    Returns
    -------
    FusedTracks    mixture of K C components, or fewer by `max_components`; mean (..., n) and cov (..., n, n)
                   are its moments, whatever its weights sum to; weights (..., K)

    Raises
    ------
    ValueError     given weights do not fit, or a component has no covariance

    Notes          Of PHDs the expected numbers of targets are averaged too. Reduction by merging keeps mean and
                   covariance; cap does not. O(K C n^2), and (K C)^2 n^3 where components are merged.
    References     T. Li et al., Second-order statistics analysis and comparison between arithmetic and
                   geometric average fusion, 2019, eq. (9).
    """
    weights = params.shares(tracks)
    return fused_tracks(params.reduce(average(params.sources(tracks), weights)), weights)


def _reduced(params: AverageParams) -> bool:
    return bool(params.max_components or params.max_source_components)


RULE = Rule(
    key="mixture_average",
    title="Average of mixtures",
    fuse=fuse,
    params=AverageParams,
    family="mixture",
    arity="n_ary",
    guarantee=lambda params: "none" if params.reduction == "cap" and _reduced(params) else "conservative",
    caveat="of the merged moments, if every track is; not where components are cut off, by reduction cap",
    source="Li 2019 (9)",
    cost="K C n^2 for C components a source, (K C)^2 n^3 to merge them",
    takes_phds=True,
    example=Example(({}, GIVEN, {"max_components": 3}), idempotent=True),
)
