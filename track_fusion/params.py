"""Parameter dataclasses: one home for a default, its type, range, unit and meaning.

A rule, filter, model or node states its parameters as a frozen dataclass whose fields are made by
:func:`param`. ROS descriptors, command-line help, the rules table and the example YAML files are
generated from these fields, and :func:`from_dict` refuses a misspelt name.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Collection, Iterable, Mapping
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")

#: More valid names than this are listed only where none is near.
MANY_NAMES = 40


class ParameterError(ValueError):
    """A parameter has a wrong name or value; the message names it, the limit and the value got."""


class Fault(Exception):
    """What a program cannot go on with, through no parameter: it ends with exit code 1 and this message, one line."""


@dataclasses.dataclass(frozen=True)
class Spec:
    """What is known of one parameter besides its name and default."""

    kind: type
    doc: str
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    choices: Collection[str] = ()
    sequence: bool = False
    strict: bool = False  # low itself is excluded

    def wanted(self) -> str:
        """Say in words which values are allowed."""
        if self.choices:
            return ("a list out of " if self.sequence else "one of ") + ", ".join(repr(c) for c in self.choices)
        noun = {float: "a number", int: "an integer", bool: "true or false", str: "a string"}[self.kind]
        if self.sequence:
            noun = {float: "numbers", int: "integers", str: "strings", bool: "booleans"}[self.kind]
            noun = f"a list of {noun}"
        limits = []
        if self.low > -math.inf:
            limits.append(f"{'>' if self.strict else '>='} {self.low:g}")
        if self.high < math.inf:
            limits.append(f"<= {self.high:g}")
        return " ".join([noun, " and ".join(limits)]).strip()


def param(
    default: Any,
    doc: str,
    *,
    unit: str = "",
    low: float = -math.inf,
    high: float = math.inf,
    choices: Collection[str] = (),
    strict: bool = False,
    kind: type | None = None,
) -> Any:
    """Make a dataclass field with its meaning, unit and range.

    A tuple default makes a list parameter; `kind` gives the element type of an empty one.
    """
    sequence = isinstance(default, tuple)
    element = kind or (type(default[0]) if sequence and default else type(default))
    spec = Spec(element, doc, unit, low, high, choices, sequence, strict)
    return dataclasses.field(default=default, metadata={"spec": spec})


def specs(params: Any) -> dict[str, tuple[Spec, Any]]:
    """Return `{name: (Spec, default)}` of a parameter dataclass (class or instance)."""
    return {f.name: (f.metadata["spec"], f.default) for f in dataclasses.fields(params)}


@dataclasses.dataclass(frozen=True)
class Params:
    """Base of every parameter dataclass: checks each value against its field on construction."""

    def __post_init__(self) -> None:
        for name, (spec, _) in specs(self).items():
            object.__setattr__(self, name, _checked(name, spec, getattr(self, name)))


def _checked(name: str, spec: Spec, value: Any) -> Any:
    if not spec.sequence:
        return _checked_scalar(name, spec, value, value)
    if isinstance(value, (str, bytes)) or not isinstance(value, (Iterable, np.ndarray)):
        raise ParameterError(f"The '{name}' parameter must be {spec.wanted()}. Got {value!r}.")
    return tuple(_checked_scalar(name, spec, v, value) for v in value)


def _checked_scalar(name: str, spec: Spec, value: Any, got: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if spec.kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    good = type(value) is spec.kind and (not spec.choices or value in spec.choices)
    if good and spec.kind in (float, int):
        # NaN fails both comparisons; infinity is allowed only where the range is open.
        above = value > spec.low if spec.strict else value >= spec.low
        good = above and value <= spec.high
    if not good:
        hint = ""
        if spec.choices and isinstance(value, str):
            hint = nearest(value, spec.choices)
        raise ParameterError(f"The '{name}' parameter must be {spec.wanted()}. Got {got!r}.{hint}")
    return value


def nearest(name: str, valid: Iterable[str]) -> str:
    """Return `" Did you mean 'x'?"` for the nearest valid name, or an empty string."""
    close = difflib.get_close_matches(name, list(valid), n=1, cutoff=0.4)
    return f" Did you mean '{close[0]}'?" if close else ""


def unknown_name_error(name: str, valid: Iterable[str], what: str = "parameter") -> ParameterError:
    """Make the error for a misspelt name, with the nearest valid one and the list of all, unless that hides it."""
    valid = sorted(valid)
    near = nearest(name, valid)
    if near and len(valid) > MANY_NAMES:
        return ParameterError(f"Unknown {what} '{name}'.{near}")
    listing = ", ".join(valid) if valid else "none"
    return ParameterError(f"Unknown {what} '{name}'.{near} Valid: {listing}.")


def from_dict(cls: type[T], values: Mapping[str, Any]) -> T:
    """Build a parameter dataclass from names and values, refusing unknown names.

    Raises
    ------
    ParameterError    a name is unknown (the nearest valid one is given) or a value out of range
    """
    valid = specs(cls)
    for name in values:
        if name not in valid:
            raise unknown_name_error(name, valid)
    return cls(**values)
