"""Parameter dataclasses as ROS parameters: declared with range and description, misspelt ones refused."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterValueException
from rclpy.node import Node

from track_fusion.models.choices import Choice, make
from track_fusion.params import ParameterError, Params, Spec, from_dict, specs, unknown_name_error
from track_fusion.random_streams import RandomParams

P = TypeVar("P", bound=Params)
T = TypeVar("T")

#: Parameters that rclpy declares by itself.
_BUILT_IN = ("use_sim_time", "start_type_description_service")
_BUILT_IN_PREFIX = "qos_overrides."
#: ROS ranges need both ends.
_WIDEST = {float: 1.7e308, int: 2**63 - 1}


def declare(node: Node, cls: type[P], prefix: str = "") -> P:
    """Declare every field of a parameter dataclass on a node and return it with the values given.

    The parameters are read-only: they take effect at start-up. The role of random numbers is the node's name unless
    given.

    Raises
    ------
    ParameterError    a value is of the wrong type or out of range; the message names the parameter
    """
    values = {}
    for name, (spec, default) in specs(cls).items():
        full = prefix + name
        # ROS knows no empty list without a type: such a default stays unset.
        start = None if default == () else list(default) if isinstance(default, tuple) else default
        try:
            given = node.declare_parameter(full, start, _descriptor(full, spec)).value
        except InvalidParameterValueException:  # the range of the descriptor; the dataclass says more
            given = node._parameter_overrides[full].value
        values[name] = default if given is None else given
    if issubclass(cls, RandomParams):
        values["role"] = values["role"] or node.get_name()
    try:
        return from_dict(cls, values)
    except ParameterError as error:
        raise ParameterError(str(error).replace("The '", f"The '{prefix}", 1)) from None


def chosen(node: Node, table: Mapping[str, Choice[T]], key: str, *before: Any) -> T:
    """Declare the parameters of one choice of a table, and of no other; make it from (*before, parameters).

    Raises
    ------
    ParameterError    a value is wrong, or the choice does not fit, say the axes
    """
    return make(table, key, declare(node, table[key].params), *before)


def _descriptor(name: str, spec: Spec) -> ParameterDescriptor:
    """Describe a parameter; types and limits are checked by the dataclass, whose messages say more."""
    descriptor = ParameterDescriptor(
        name=name,
        description=spec.doc + (f" [{spec.unit}]" if spec.unit else ""),
        additional_constraints=spec.wanted(),
        read_only=True,
        dynamic_typing=True,
    )
    if not spec.sequence and spec.kind in _WIDEST and (spec.low > -math.inf or spec.high < math.inf):
        widest = _WIDEST[spec.kind]
        low, high = spec.kind(max(spec.low, -widest)), spec.kind(min(spec.high, widest))
        if spec.kind is float:
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
        else:
            descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
    return descriptor


def refuse_of_others(node: Node, table: Collection[str], choice: str, key: str) -> None:
    """Check that no parameter of another entry of a table is given; those of an entry are named `<key>.<name>`.

    Raises
    ------
    ParameterError    one belongs to an entry that was not chosen
    """
    for name in node._parameter_overrides:
        owner, dot, _ = name.partition(".")
        if dot and owner != key and owner in table:
            raise ParameterError(f"The '{name}' parameter belongs to '{owner}', but {choice} is '{key}'.")


def unfit_files(arguments: Sequence[str], node: str) -> dict[str, list[str]]:
    """Return the parameter files of a command line that hold nothing for a node, with the names they do hold.

    Parameters
    ----------
    arguments : such as sys.argv
    node : full name, after remapping
    """
    import yaml  # type: ignore[import-untyped]  # comes with rclpy

    unfit, inside = {}, False
    for word, following in zip(arguments, [*arguments[1:], ""], strict=True):
        inside = word == "--ros-args" or (inside and word != "--")
        if inside and word == "--params-file":
            names = _sections(yaml.safe_load(Path(following).read_text()))
            if not any(_fits(name.split("/"), node.strip("/").split("/")) for name in names):
                unfit[following] = names
    return unfit


def _sections(content: Any, above: str = "") -> list[str]:
    """List the names of the sections of a parameter file; namespaces may be nested."""
    if not isinstance(content, Mapping):
        return []
    names = [above] if "ros__parameters" in content else []
    inner = {name: below for name, below in content.items() if name != "ros__parameters"}
    for name, below in inner.items():
        names += _sections(below, f"{above}/{str(name).strip('/')}".strip("/"))
    return names


def _fits(pattern: Sequence[str], name: Sequence[str]) -> bool:
    """Match the words of a name: * is any one, ** any number of them."""
    if not pattern or not name:
        return not name and all(word == "**" for word in pattern)
    if pattern[0] == "**":
        return _fits(pattern[1:], name) or _fits(pattern, name[1:])
    return pattern[0] in ("*", name[0]) and _fits(pattern[1:], name[1:])


def refuse_unknown(node: Node) -> None:
    """Check, once all is declared, that every parameter given on start-up exists.

    Raises
    ------
    ParameterError    a name is unknown; the nearest valid one is given
    """
    valid = [n for n in node._parameters if not n.startswith(_BUILT_IN_PREFIX)]
    for name in node._parameter_overrides:
        if name not in valid and name not in _BUILT_IN and not name.startswith(_BUILT_IN_PREFIX):
            raise unknown_name_error(name, valid)
