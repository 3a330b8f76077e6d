"""Charts as data: what a scenario shows, drawn by report/drawing.py and written to the JSON as it is."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Literal

import numpy as np

from track_fusion.linalg import Array
from track_fusion.metrics.accuracy import Estimate

Style = Literal["line", "dashed", "dotted", "steps", "points", "bars"]


@dataclasses.dataclass(frozen=True)
class Series:
    """One line, cloud of points or set of bars.

    Attributes
    ----------
    label : str        in the legend; "" = not there
    x, y : (P,)        NaN in y interrupts a line
    style : Style
    error : (P,) or None    half the width of a band (of bars: of a whisker) around y
    """

    label: str
    x: Array
    y: Array
    style: Style = "line"
    error: Array | None = None


@dataclasses.dataclass(frozen=True)
class Contours:
    """Lines of equal value of a function of the plane.

    Attributes
    ----------
    label : str
    x (P,), y (Q,), z (Q, P)
    levels : tuple of float    values of z at the lines, ascending
    """

    label: str
    x: Array
    y: Array
    z: Array
    levels: tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class Chart:
    """One panel.

    Attributes
    ----------
    title, x_label, y_label : str    with units
    series : tuple of Series
    contours : tuple of Contours
    log_x, log_y : bool              logarithmic axes
    equal : bool                     one unit is as long along x as along y
    ticks : mapping or None          x position -> text, for bars and groups
    """

    title: str
    x_label: str
    y_label: str
    series: tuple[Series, ...] = ()
    contours: tuple[Contours, ...] = ()
    log_x: bool = False
    log_y: bool = False
    equal: bool = False
    ticks: dict[float, str] | None = None


def estimates(label: str, values: Mapping[int, Estimate] | Mapping[float, Estimate], style: Style = "points") -> Series:
    """Figures over x with their standard errors."""
    errors = np.nan_to_num([e.standard_error for e in values.values()])
    return Series(label, np.array(list(values), float), np.array([e.value for e in values.values()]), style, errors)


def bars(title: str, y_label: str, values: Mapping[str, Estimate], wanted: str = "", log_y: bool = False) -> Chart:
    """Figures as bars side by side, by what stands below them; a line at 1 where `wanted` says what that is."""
    places = [float(i) for i in range(len(values))]
    series = [estimates("", dict(zip(places, values.values(), strict=True)), "bars")]
    if wanted:
        series.append(Series(wanted, np.array([0.0, len(values) - 1.0]), np.ones(2), "dashed"))
    ticks = dict(zip(places, values, strict=True))
    return Chart(title, "", y_label, tuple(series), log_y=log_y, ticks=ticks)


#: Points around an ellipse.
AROUND = 73


def ellipse(label: str, mean: Array, cov: Array, sigmas: float = 2.0, style: Style = "line") -> Series:
    """Ellipse of so many standard deviations of a Gaussian of the plane, mean (2,), cov (2, 2), as a line."""
    angle = np.linspace(0.0, 2.0 * np.pi, AROUND)
    x, y = mean[:, None] + sigmas * np.linalg.cholesky(cov) @ np.stack([np.cos(angle), np.sin(angle)])
    return Series(label, x, y, style)
