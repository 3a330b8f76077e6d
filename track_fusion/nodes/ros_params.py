"""Parameter dataclasses as ROS parameters: declared with range and description, misspelt ones refused."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterValueException
from rclpy.node import Node

from track_fusion.messages.parameters import fits, refuse_unknown, sections_of, with_prefix
from track_fusion.models.choices import Choice, make
from track_fusion.params import Params, Spec, specs

P = TypeVar("P", bound=Params)
T = TypeVar("T")

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
    return with_prefix(cls, values, prefix, node.get_name())


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


def unfit_files(arguments: Sequence[str], node: str) -> dict[str, list[str]]:
    """Return the parameter files of a command line that hold nothing for a node, with the names they do hold.

    Parameters
    ----------
    arguments : such as sys.argv
    node : full name, after remapping
    """
    unfit, inside = {}, False
    for word, following in zip(arguments, [*arguments[1:], ""], strict=True):
        inside = word == "--ros-args" or (inside and word != "--")
        if inside and word == "--params-file":
            names = list(sections_of(Path(following)))
            if not any(fits(name, node) for name in names):
                unfit[following] = names
    return unfit


def refuse_unknown_of(node: Node) -> None:
    """Check, once all is declared, that every parameter given on start-up exists; raise as `refuse_unknown`."""
    refuse_unknown(node._parameter_overrides, node._parameters)
