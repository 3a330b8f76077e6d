"""The axes of a node, as its parameters name them."""

from __future__ import annotations

import numpy as np
import pytest

from track_fusion.angles import HALF_TURN, TURN
from track_fusion.messages.screening import FrameParams
from track_fusion.params import ParameterError


def test_known_names_and_named_axes_wrap() -> None:
    frame = FrameParams(axes=("x", "yaw", "psi", "phi"), angular=("psi",))
    assert frame.layout.axes == frame.axes
    np.testing.assert_array_equal(frame.layout.periods, [np.inf, TURN, TURN, np.inf])


def test_directions_of_unknown_sign_have_half_the_period() -> None:
    frame = FrameParams(axes=("x", "yaw", "psi", "phi"), angular=("yaw:pi", "psi:pi"))
    np.testing.assert_array_equal(frame.layout.periods, [np.inf, HALF_TURN, HALF_TURN, np.inf])


@pytest.mark.parametrize("spelt", ["psi", "psi:pi", "x:2"])
def test_what_wraps_must_be_an_axis(spelt: str) -> None:
    with pytest.raises(ParameterError) as caught:
        FrameParams(axes=("x", "y"), angular=(spelt,))
    assert str(caught.value) == f"The 'angular' parameter must name axes of x, y. Got {spelt!r}."


def test_an_axis_has_one_period() -> None:
    with pytest.raises(ParameterError) as caught:
        FrameParams(axes=("x", "yaw"), angular=("yaw", "yaw:pi"))
    assert str(caught.value) == "The 'angular' parameter must name an axis once. Got 'yaw:pi' after another 'yaw'."
