"""Published scenarios, one a file; `SCENARIOS` lists them all by key."""

from __future__ import annotations

from track_fusion.params import unknown_name_error
from track_fusion.plugins import from_file, is_path
from track_fusion.scenarios.ahmed import maneuver, proposals, random, search
from track_fusion.scenarios.chen2022 import dynamic_1, dynamic_2, static
from track_fusion.scenarios.li2019 import densities, mixture, six_sensors, variables
from track_fusion.scenarios.li2022 import four_cases, linear, nonlinear, target_fit
from track_fusion.scenarios.sharma import gaussians, mixtures, network_1, network_2, radars, scalar
from track_fusion.study.scenario import Scenario

_MODULES = (
    *(linear, nonlinear, four_cases, target_fit),
    *(static, dynamic_1, dynamic_2),
    *(variables, densities, mixture, six_sensors),
    *(random, proposals, search, maneuver),
    *(gaussians, mixtures, scalar, network_1, network_2, radars),
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
