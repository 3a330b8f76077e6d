"""The axes of a node, as its parameters name them."""

from __future__ import annotations

import numpy as np
import pytest

from track_fusion.angles import TURN
from track_fusion.messages.screening import FrameParams
from track_fusion.params import ParameterError


def test_known_names_and_named_axes_wrap() -> None:
    frame = FrameParams(axes=("x", "yaw", "psi", "phi"), angular=("psi",))
    assert frame.layout.axes == frame.axes
    np.testing.assert_array_equal(frame.layout.periods, [np.inf, TURN, TURN, np.inf])


def test_what_wraps_must_be_an_axis() -> None:
    with pytest.raises(ParameterError) as caught:
        FrameParams(axes=("x", "y"), angular=("psi",))
    assert str(caught.value) == "The 'angular' parameter must name axes of x, y. Got 'psi'."
