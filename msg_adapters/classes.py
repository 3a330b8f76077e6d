"""Classes of messages by the name of their type; imported when they are asked for, so that reading needs no ROS."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable
from typing import Any

#: Gives the class of a type such as "sensor_msgs/msg/PointCloud2"; its fields are keyword arguments. A reader or writer
#: of bags has classes of its own.
Classes = Callable[[str], Any]


@functools.cache
def message_class(name: str) -> type:
    """Import the class of a type such as sensor_msgs/msg/PointCloud2 from ROS.

    Raises
    ------
    ImportError    its package is not installed, or has no such message
    """
    package, _, kind = name.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), kind)  # type: ignore[no-any-return]
    except (ImportError, AttributeError) as error:
        apt = f"ros-jazzy-{package.replace('_', '-')}"
        raise ImportError(
            f"Messages of the type {name} need the package '{package}' ({error}). Install {apt}."
        ) from error
