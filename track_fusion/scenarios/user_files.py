"""Rules and scenarios by key, or from a Python file of the user's own: nothing to install to try an idea."""

from __future__ import annotations

import functools
import importlib.util
import sys
from pathlib import Path
from typing import TypeVar

from track_fusion.params import ParameterError
from track_fusion.rules import RULES, Rule, get_rule
from track_fusion.scenarios import get_scenario
from track_fusion.scenarios.base import Scenario

T = TypeVar("T")


def is_path(name: str) -> bool:
    """Tell a file from a key."""
    return name.endswith(".py")


def find_scenario(name: str) -> Scenario:
    """Return the scenario of a key, or the SCENARIO that a Python file defines.

    Raises
    ------
    ParameterError    there is none
    """
    return _defined(name, "SCENARIO", Scenario) if is_path(name) else get_scenario(name)


def find_rule(name: str) -> Rule:
    """Return the rule of a key, or the RULE that a Python file defines, which is then known by its key, too.

    Raises
    ------
    ParameterError    there is none, or the file's key is that of another rule
    """
    if not is_path(name):
        return get_rule(name)
    rule = _defined(name, "RULE", Rule)
    if RULES.setdefault(rule.key, rule) is not rule:
        raise ParameterError(f"The rule of {name} must have a key of its own. Got '{rule.key}', which is taken.")
    return rule


@functools.cache
def _defined(path: str, name: str, kind: type[T]) -> T:
    """Run a Python file and return what it defines under a name."""
    if not Path(path).is_file():
        raise ParameterError(f"There is no file '{path}'.")
    spec = importlib.util.spec_from_file_location(f"_given_{Path(path).stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    found = getattr(module, name, None)
    if not isinstance(found, kind):
        raise ParameterError(f"The file '{path}' must define {name}, a {kind.__name__}. Got {found!r}.")
    return found
