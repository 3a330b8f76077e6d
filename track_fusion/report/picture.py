"""A picture of truth, source tracks and fused track with 2-sigma ellipses."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from track_fusion.linalg import Array
from track_fusion.report.drawing import pyplot

#: Ellipses are drawn at this many standard deviations.
SIGMAS = 2.0
#: Every so many steps, so that ellipses stay apart.
ELLIPSE_EVERY = 2
#: The close-up shows the last steps.
CLOSE_UP = 9


@dataclasses.dataclass(frozen=True)
class Line:
    """One track over time: position (T, d) in metres, position covariance (T, d, d) or None for the truth; d 1 or 2."""

    label: str
    color: str
    position: Array
    cov: Array | None = None


def draw(path: Path, title: str, truth: Line, tracks: Sequence[Line]) -> None:
    """Draw the whole course, a close-up of its end, and each track's position error over time, as PNG.

    Parameters
    ----------
    path : Path
    title : str
    truth : Line               cov None
    tracks : sequence of Line  the same T steps; the last is drawn on top with its ellipses
    """
    figure, (course, close, error) = pyplot().subplots(1, 3, figsize=(16, 5.2), constrained_layout=True)
    figure.suptitle(title)
    _draw_course(course, truth, tracks, 0)
    _draw_course(close, truth, tracks, max(0, len(truth.position) - CLOSE_UP))
    course.legend(loc="best", fontsize=9)
    course.set_title("course")
    ellipses = f", {SIGMAS:g}-sigma ellipses every {ELLIPSE_EVERY}" if truth.position.shape[1] > 1 else ""
    close.set_title(f"last {CLOSE_UP} steps{ellipses}")
    for line in tracks:
        error.plot(np.linalg.norm(line.position - truth.position, axis=1), color=line.color, label=line.label)
    error.set(title="position error", xlabel="step", ylabel="m")
    error.set_ylim(bottom=0)
    _save(path, figure, (course, close, error))


def _draw_course(axes: Any, truth: Line, tracks: Sequence[Line], start: int) -> None:
    """Draw from a step on, with ellipses unless that is the first."""
    axes.plot(*_course(truth, start), color=truth.color, lw=2.0, label=truth.label)
    for line in tracks:
        axes.plot(*_course(line, start), ".-", ms=3, lw=0.9, color=line.color, label=line.label)
    if truth.position.shape[1] == 1:
        axes.set(xlabel="step", ylabel="x / m")
        return
    for line in tracks if start else ():
        _ellipses(axes, line, start)
    axes.set_aspect("equal", "datalim")
    axes.set(xlabel="x / m", ylabel="y / m")


def _course(line: Line, start: int) -> tuple[Array, Array]:
    """Coordinates to be drawn: y over x, or of a target on a line its x over the steps."""
    position = line.position[start:]
    if position.shape[1] == 1:
        return np.arange(start, len(line.position), dtype=float), position[:, 0]
    return position[:, 0], position[:, 1]


def draw_map(path: Path, title: str, lines: Sequence[Line]) -> None:
    """Draw the positions of many targets in one plane as PNG: the first is the truth, each a set of points."""
    figure, axes = pyplot().subplots(figsize=(10, 9), constrained_layout=True)
    for order, line in enumerate(lines):
        size, (x, y) = 1.0 if line.cov is None else 9.0 / order, line.position.T / 1e3
        axes.scatter(x, y, s=size, color=line.color, label=line.label, linewidths=0)
    axes.set_aspect("equal", "datalim")
    axes.set(title=title, xlabel="x / km", ylabel="y / km")
    axes.legend(loc="best", markerscale=3)
    _save(path, figure, (axes,))


def _save(path: Path, figure: Any, panels: Sequence[Any]) -> None:
    for axes in panels:
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
    pyplot().close(figure)


def _ellipses(axes: Any, line: Line, start: int) -> None:
    from matplotlib.patches import Ellipse

    if line.cov is None:
        return
    for k in range(len(line.position) - 1, start - 1, -ELLIPSE_EVERY):
        values, vectors = np.linalg.eigh(line.cov[k])
        width, height = 2.0 * SIGMAS * np.sqrt(values)
        angle = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
        axes.add_patch(Ellipse(line.position[k], width, height, angle=angle, fill=False, color=line.color, alpha=0.8))
