"""Naive fusion: multiply the densities as if the tracks were independent."""

from __future__ import annotations

import numpy as np

from track_fusion.densities.gaussian import weighted_product
from track_fusion.params import Params
from track_fusion.rules.base import Example, FusedTracks, Rule, SourceTracks


def fuse(tracks: SourceTracks, params: Params) -> FusedTracks:
    """Fuse K Gaussian tracks by naive fusion: P^-1 = sum of P_i^-1.

    Right only for tracks whose errors are independent; common process noise or a common past makes it
    overconfident.

    Parameters
    ----------
    tracks : SourceTracks    mean (..., K, n), cov (..., K, n, n)
    params : Params          none

    Returns
    -------
    FusedTracks    mean (..., n), cov (..., n, n)

    Raises
    ------
    LinAlgError    a covariance is singular

    Notes          No guarantee: K copies of one track N(0, P) claim P / K with an error of P. O(K n^3).
    References     T. Li et al., Some Statistic and Information-theoretic Results on Arithmetic Average
                   Density Fusion, eq. (14).
    """
    return FusedTracks(*weighted_product(tracks.mean, tracks.cov, np.ones(tracks.mean.shape[:-1])))


RULE = Rule(
    key="naive",
    title="Naive fusion",
    fuse=fuse,
    params=Params,
    family="gaussian",
    arity="n_ary",
    guarantee="none",
    caveat="exact for independent errors only; K copies of one track claim P / K",
    source="Li 2022 (14)",
    cost="K n^3",
    linear=True,
    example=Example(idempotent=False),
)
