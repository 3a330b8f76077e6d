"""Axes without a motion of their own, such as yaw, length, width and height: they follow a random walk."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from track_fusion.layouts import StateLayout
from track_fusion.linalg import Array
from track_fusion.params import ParameterError, param

#: Axes that only move together, or not at all: none of them follows a random walk beside a motion of others.
KINEMATIC = frozenset(prefix + axis for prefix in ("", "v", "a") for axis in "xyz")


def random_walk_param() -> Any:
    """Make the parameter `random_walk_noise` of a motion: one home for its default and meaning."""
    return param(
        (0.1,),
        "standard deviation that an axis without a motion of its own (yaw, length, ...) gains in a second, in its unit "
        "per sqrt(s): one number for all such axes, or one for each, in the order of the state",
        low=0.0,
    )


def random_walk(layout: StateLayout, own: Sequence[str], noise: tuple[float, ...], wanted: str) -> Array:
    """Return the variance that each axis gains in a second by a random walk, (n,); 0 for the `own` axes of a motion.

    Parameters
    ----------
    layout : StateLayout
    own : names that the motion itself moves
    noise : tuple of float    standard deviations, one or one for each other axis, unit per sqrt(s)
    wanted : str              how an error begins: which axes the motion needs

    Raises
    ------
    ValueError        an own axis is missing, or a position, velocity or acceleration is not the motion's
    ParameterError    another number of standard deviations
    """
    others = [axis for axis in layout.axes if axis not in own]
    if not own or not set(own) <= set(layout.axes) or KINEMATIC & set(others):
        raise ValueError(f"{wanted}. Got {', '.join(layout.axes)}.")
    if len(noise) not in (1, len(others)):
        names = f", or one for each of {', '.join(others)}" if others else ": every axis has a motion of its own"
        raise ParameterError(f"The 'random_walk_noise' parameter must hold one number{names}. Got {len(noise)}.")
    strength = np.zeros(layout.size)
    strength[list(layout.indices(others))] = np.square(noise)
    return strength
