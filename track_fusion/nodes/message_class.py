"""Message classes by the names of their types."""

from __future__ import annotations

import importlib
from typing import Any

from track_fusion.params import Fault


def message_class(name: str) -> Any:
    """Return the class of a type such as sensor_msgs/msg/PointCloud2.

    Raises
    ------
    Fault    its package is not installed
    """
    package, _, kind = name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), kind)
    except (ImportError, AttributeError):
        raise Fault(
            f"The type {name} cannot be had: its package {package} is not installed here. Leave its topics out "
            "(of a bag: by bag_topics)."
        ) from None
