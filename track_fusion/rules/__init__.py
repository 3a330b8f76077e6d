"""Fusion rules, one a file; `RULES` lists them all by key."""

from __future__ import annotations

from track_fusion.params import unknown_name_error
from track_fusion.rules import (
    arithmetic_average,
    covariance_intersection,
    covariance_union,
    cross_covariance,
    ellipsoidal_intersection,
    fast_covariance_intersection,
    fault_tolerant_covariance_intersection,
    geodesic_projection,
    geometric_average,
    geometric_mean_sampling,
    harmonic_mean,
    inverse_covariance_intersection,
    mhdp_explicit,
    mhdp_iterative,
    mixture_average,
    mixture_exact,
    mixture_geometric,
    mixture_hybrid,
    mixture_wep,
    naive,
    quasi_minimal_manhattan,
    split_covariance_intersection,
)
from track_fusion.rules.base import FusedTracks, Mixture, Rule, SourceTracks

_MODULES = (
    naive,
    covariance_intersection,
    arithmetic_average,
    fast_covariance_intersection,
    fault_tolerant_covariance_intersection,
    inverse_covariance_intersection,
    ellipsoidal_intersection,
    covariance_union,
    geometric_average,
    harmonic_mean,
    geometric_mean_sampling,
    cross_covariance,
    split_covariance_intersection,
    mhdp_explicit,
    mhdp_iterative,
    quasi_minimal_manhattan,
    geodesic_projection,
    mixture_average,
    mixture_geometric,
    mixture_hybrid,
    mixture_wep,
    mixture_exact,
)

#: Every rule by its key: what `state_fusion` may be.
RULES: dict[str, Rule] = {module.RULE.key: module.RULE for module in _MODULES}


def get_rule(key: str) -> Rule:
    """Return the rule of this key.

    Raises
    ------
    ParameterError    no such rule; the nearest key is given
    """
    if key not in RULES:
        raise unknown_name_error(key, RULES, "rule")
    return RULES[key]


__all__ = ["RULES", "FusedTracks", "Mixture", "Rule", "SourceTracks", "get_rule"]
