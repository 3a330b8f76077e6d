"""Fusion rules, one a file; `RULES` lists them all by key."""

from __future__ import annotations

from track_fusion.params import ParameterError, unknown_name_error
from track_fusion.plugins import from_file, is_path
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


def find_rule(name: str) -> Rule:
    """Return the rule of a key, or the RULE that a Python file defines, which is then known by its key, too.

    Raises
    ------
    ParameterError    there is none, or the file's key is that of another rule
    """
    if not is_path(name):
        return get_rule(name)
    rule = from_file(name, "RULE", Rule)
    if RULES.setdefault(rule.key, rule) is not rule:
        raise ParameterError(f"The rule of {name} must have a key of its own. Got '{rule.key}', which is taken.")
    return rule


__all__ = ["RULES", "FusedTracks", "Mixture", "Rule", "SourceTracks", "find_rule", "get_rule"]
