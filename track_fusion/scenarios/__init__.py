"""Published scenarios, one a file; `SCENARIOS` lists them all by key."""

from __future__ import annotations

from track_fusion.params import unknown_name_error
from track_fusion.scenarios import (
    ahmed_maneuver,
    ahmed_proposals,
    ahmed_random,
    ahmed_search,
    chen2022_dynamic_1,
    chen2022_dynamic_2,
    chen2022_static,
    li2019_densities,
    li2019_mixture,
    li2019_six_sensors,
    li2019_variables,
    li2022_four_cases,
    li2022_linear,
    li2022_nonlinear,
    li2022_target_fit,
    sharma_gaussians,
    sharma_mixtures,
    sharma_network_1,
    sharma_network_2,
    sharma_radars,
    sharma_scalar,
)
from track_fusion.scenarios.base import (
    Claim,
    RuleChoice,
    Samples,
    Scenario,
    Scene,
    Tracking,
)
from track_fusion.scenarios.judgement import judged_claims, judged_figures

_MODULES = (
    li2022_linear,
    li2022_nonlinear,
    li2022_four_cases,
    li2022_target_fit,
    chen2022_static,
    chen2022_dynamic_1,
    chen2022_dynamic_2,
    li2019_variables,
    li2019_densities,
    li2019_mixture,
    li2019_six_sensors,
    ahmed_random,
    ahmed_proposals,
    ahmed_search,
    ahmed_maneuver,
    sharma_gaussians,
    sharma_mixtures,
    sharma_scalar,
    sharma_network_1,
    sharma_network_2,
    sharma_radars,
)

SCENARIOS: dict[str, Scenario] = {module.SCENARIO.key: module.SCENARIO for module in _MODULES}


def get_scenario(key: str) -> Scenario:
    """Return the scenario of this key.

    Raises
    ------
    ParameterError    no such scenario; the nearest key is given
    """
    if key not in SCENARIOS:
        raise unknown_name_error(key, SCENARIOS, "scenario")
    return SCENARIOS[key]


__all__ = [
    "SCENARIOS",
    "Claim",
    "RuleChoice",
    "Samples",
    "Scenario",
    "Scene",
    "Tracking",
    "get_scenario",
    "judged_claims",
    "judged_figures",
]
