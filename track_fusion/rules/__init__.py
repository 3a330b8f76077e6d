"""Fusion rules, one a file; `RULES` lists them all by key."""

from __future__ import annotations

import importlib

from track_fusion.plugins import Registry, from_file, from_module, is_path
from track_fusion.rules.base import Example, FusedTracks, Mixture, Rule, SourceTracks

#: Our rules in the order of lists: each is RULE in the module of that name.
KEYS = (
    "naive",
    "covariance_intersection",
    "arithmetic_average",
    "fast_covariance_intersection",
    "fault_tolerant_covariance_intersection",
    "inverse_covariance_intersection",
    "ellipsoidal_intersection",
    "covariance_union",
    "geometric_average",
    "harmonic_mean",
    "geometric_mean_sampling",
    "cross_covariance",
    "split_covariance_intersection",
    "mhdp_explicit",
    "mhdp_iterative",
    "quasi_minimal_manhattan",
    "geodesic_projection",
    "mixture_average",
    "mixture_geometric",
    "mixture_hybrid",
    "mixture_wep",
    "mixture_exact",
)

#: Every rule by its key, those of other packages included: what `state_fusion` may be.
RULES: Registry[Rule] = Registry(
    "track_fusion.rules", "rule", Rule, {key: importlib.import_module(f"{__name__}.{key}").RULE for key in KEYS}
)


def get_rule(key: str) -> Rule:
    """Return the rule of this key.

    Raises
    ------
    ParameterError    no such rule; the nearest key is given
    """
    return RULES[key]


def find_rule(name: str) -> Rule:
    """Return the rule of a key, of a Python file (its RULE) or of `module:attribute`; it is then known by its key, too.

    Raises
    ------
    ParameterError    there is none, or its key is that of another rule
    """
    if not is_path(name) and ":" not in name:
        return RULES[name]
    rule = from_file(name, "RULE", Rule) if is_path(name) else from_module(name, Rule)
    RULES.add(rule.key, rule, name)
    return rule


__all__ = ["RULES", "Example", "FusedTracks", "Mixture", "Rule", "SourceTracks", "find_rule", "get_rule"]
