"""Objects from a Python file of the user's own: nothing to install to try an idea."""

from __future__ import annotations

import functools
import importlib.util
import sys
from pathlib import Path
from typing import TypeVar

from track_fusion.params import ParameterError

T = TypeVar("T")


def is_path(name: str) -> bool:
    """Tell a file from a key."""
    return name.endswith(".py")


@functools.cache
def from_file(path: str, name: str, kind: type[T]) -> T:
    """Run a Python file, once, and return what it defines under a name.

    Raises
    ------
    ParameterError    there is no such file, or it does not define it
    """
    if not Path(path).is_file():
        raise ParameterError(f"There is no file '{path}'.")
    spec = importlib.util.spec_from_file_location(f"_given_{Path(path).stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    given = getattr(module, name, None)
    if not isinstance(given, kind):
        raise ParameterError(f"The file '{path}' must define {name}, a {kind.__name__}. Got {given!r}.")
    return given
