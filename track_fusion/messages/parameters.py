"""Parameters of a node, read from its parameter file with or without ROS: the same names, the same errors."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

from track_fusion.params import Fault, ParameterError, Params, from_dict, param, specs, unknown_name_error
from track_fusion.random_streams import RandomParams

P = TypeVar("P", bound=Params)

#: Parameters that ROS gives every node.
BUILT_IN = ("use_sim_time", "start_type_description_service")
BUILT_IN_PREFIX = "qos_overrides."
#: Numbers such as 1e-3, which YAML 1.1 takes for text and ROS for a number.
_FLOAT = re.compile(r"[-+]?[0-9]+(?:\.[0-9]*)?[eE][-+]?[0-9]+")


@dataclasses.dataclass(frozen=True)
class ManagedParams(Params):
    """Life of a node."""

    autostart: bool = param(True, "configure and activate at start; false: wait for lifecycle transitions")
    expected_subscribers: int = param(
        0,
        "hold input back until ~/tracks has so many subscribers, so that none misses the first message; 0: do not wait",
        low=0,
    )
    subscribers_deadline_s: float = param(
        20.0, "after this wall time work begins without the missing subscribers, with a warning", unit="s", low=0.0
    )


class Declare(Protocol):
    """Gives a parameter dataclass with the values that a user gave."""

    def __call__(self, cls: type[P], prefix: str = "") -> P:
        """Return it; the name of each field is known from then on, after `prefix`.

        Raises
        ------
        ParameterError    a value is of the wrong type or out of range; the message names the parameter
        """


class GivenParameters:
    """Parameters by name, given to dataclasses as a node gives them; a :class:`Declare`.

    Parameters
    ----------
    values : {name: value}    such as {"axes": ["x", "y"], "covariance_intersection.criterion": "det"}
    node : str                the role of random numbers unless given
    """

    def __init__(self, values: Mapping[str, Any], node: str) -> None:
        self.values, self._node = dict(values), node
        self._known = set(BUILT_IN)

    def __call__(self, cls: type[P], prefix: str = "") -> P:
        """Return a dataclass with the values given."""
        names = specs(cls)
        self._known |= {prefix + name for name in names}
        given = {name: self.values[prefix + name] for name in names if prefix + name in self.values}
        return with_prefix(cls, given, prefix, self._node)

    def refuse_unknown(self) -> None:
        """Check, once all is declared, that every name given exists; raise as `refuse_unknown`."""
        refuse_unknown(self.values, self._known)


def with_prefix(cls: type[P], values: Mapping[str, Any], prefix: str, node: str) -> P:
    """Build a dataclass whose parameters a user knows with a prefix; random numbers get the node's role unless given.

    Raises
    ------
    ParameterError    a value is of the wrong type or out of range; the message names the parameter with its prefix
    """
    if issubclass(cls, RandomParams) and not values.get("role"):
        values = {**values, "role": node}
    try:
        return from_dict(cls, values)
    except ParameterError as error:
        raise ParameterError(str(error).replace("The '", f"The '{prefix}", 1)) from None


def refuse_unknown(given: Iterable[str], known: Iterable[str]) -> None:
    """Check that every parameter given exists.

    Raises
    ------
    ParameterError    a name is unknown; the nearest valid one is given
    """
    valid = [name for name in known if not name.startswith(BUILT_IN_PREFIX)]
    for name in given:
        if name not in valid and name not in BUILT_IN and not name.startswith(BUILT_IN_PREFIX):
            raise unknown_name_error(name, valid)


def refuse_of_others(given: Iterable[str], table: Collection[str], choice: str, key: str) -> None:
    """Check that no parameter of another entry of a table is given; those of an entry are named `<key>.<name>`.

    Raises
    ------
    ParameterError    one belongs to an entry that was not chosen
    """
    for name in given:
        owner, dot, _ = name.partition(".")
        if dot and owner != key and owner in table:
            raise ParameterError(f"The '{name}' parameter belongs to '{owner}', but {choice} is '{key}'.")


def parameters_of(path: Path, node: str) -> dict[str, Any]:
    """Read what a parameter file gives a node, by name; nested names are joined by dots.

    Parameters
    ----------
    path : Path
    node : str     full name, such as /fusion_centre

    Raises
    ------
    Fault             the file cannot be read
    ParameterError    it is no parameter file, or has nothing for this node
    """
    sections = sections_of(path)
    fitting = [section for name, section in sections.items() if fits(name, node)]
    if not fitting:
        has = ", ".join(sections) or "no section"
        raise ParameterError(f"The file {path} has no parameters for {node}. It has {has}.")
    return {name: value for section in fitting for name, value in _flat(section).items()}


def sections_of(path: Path) -> dict[str, Mapping[str, Any]]:
    """Return the sections of a parameter file by the name of the node, which may hold wildcards; raise as above."""
    import yaml  # type: ignore[import-untyped]  # comes with rclpy, and with the extra "bags"

    class Loader(yaml.SafeLoader):  # type: ignore[misc]
        """Reads numbers as ROS does."""

    Loader.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+0123456789"))
    try:
        content = yaml.load(path.read_text(), Loader)
    except OSError as error:
        raise Fault(f"The parameter file {path} cannot be read: {error.strerror}.") from None
    except yaml.YAMLError as error:
        raise ParameterError(f"The parameter file {path} is not YAML: {error}") from None
    return _sections(content)


def fits(pattern: str, node: str) -> bool:
    """Tell whether the name of a section, which may hold the wildcards * and **, is that of a node."""
    return _fits(pattern.strip("/").split("/"), node.strip("/").split("/"))


def _sections(content: Any, above: str = "") -> dict[str, Mapping[str, Any]]:
    """List the sections of a parameter file; namespaces may be nested."""
    if not isinstance(content, Mapping):
        return {}
    own = content.get("ros__parameters")
    sections = {above: own if isinstance(own, Mapping) else {}} if "ros__parameters" in content else {}
    inner = {name: below for name, below in content.items() if name != "ros__parameters"}
    for name, below in inner.items():
        sections |= _sections(below, f"{above}/{str(name).strip('/')}".strip("/"))
    return sections


def _flat(section: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in section.items():
        flat |= _flat(value, f"{above}{name}.") if isinstance(value, Mapping) else {f"{above}{name}": value}
    return flat


def _fits(pattern: Sequence[str], name: Sequence[str]) -> bool:
    """Match the words of a name: * is any one, ** any number of them."""
    if not pattern or not name:
        return not name and all(word == "**" for word in pattern)
    if pattern[0] == "**":
        return _fits(pattern[1:], name) or _fits(pattern, name[1:])
    return pattern[0] in ("*", name[0]) and _fits(pattern[1:], name[1:])
