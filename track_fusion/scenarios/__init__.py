"""Published scenarios, one a file; `SCENARIOS` lists them all by key."""

from __future__ import annotations

from track_fusion.params import unknown_name_error
from track_fusion.plugins import from_file, is_path
from track_fusion.scenarios.ahmed import maneuver as ahmed_maneuver
from track_fusion.scenarios.ahmed import proposals as ahmed_proposals
from track_fusion.scenarios.ahmed import random as ahmed_random
from track_fusion.scenarios.ahmed import search as ahmed_search
from track_fusion.scenarios.chen2022 import dynamic_1 as chen2022_dynamic_1
from track_fusion.scenarios.chen2022 import dynamic_2 as chen2022_dynamic_2
from track_fusion.scenarios.chen2022 import static as chen2022_static
from track_fusion.scenarios.li2019 import densities as li2019_densities
from track_fusion.scenarios.li2019 import mixture as li2019_mixture
from track_fusion.scenarios.li2019 import six_sensors as li2019_six_sensors
from track_fusion.scenarios.li2019 import variables as li2019_variables
from track_fusion.scenarios.li2022 import four_cases as li2022_four_cases
from track_fusion.scenarios.li2022 import linear as li2022_linear
from track_fusion.scenarios.li2022 import nonlinear as li2022_nonlinear
from track_fusion.scenarios.li2022 import target_fit as li2022_target_fit
from track_fusion.scenarios.sharma import gaussians as sharma_gaussians
from track_fusion.scenarios.sharma import mixtures as sharma_mixtures
from track_fusion.scenarios.sharma import network_1 as sharma_network_1
from track_fusion.scenarios.sharma import network_2 as sharma_network_2
from track_fusion.scenarios.sharma import radars as sharma_radars
from track_fusion.scenarios.sharma import scalar as sharma_scalar
from track_fusion.study.judgement import judged_claims, judged_figures
from track_fusion.study.scenario import (
    Claim,
    RuleChoice,
    Samples,
    Scenario,
    Scene,
    Tracking,
)

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


def find_scenario(name: str) -> Scenario:
    """Return the scenario of a key, or the SCENARIO that a Python file defines.

    Raises
    ------
    ParameterError    there is none
    """
    return from_file(name, "SCENARIO", Scenario) if is_path(name) else get_scenario(name)


__all__ = [
    "SCENARIOS",
    "Claim",
    "RuleChoice",
    "Samples",
    "Scenario",
    "Scene",
    "Tracking",
    "find_scenario",
    "get_scenario",
    "judged_claims",
    "judged_figures",
]
