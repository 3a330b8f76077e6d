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


def draw(path: Path, title: str, truth: Line, tracks: Sequence[Line], errors: str = "position error") -> None:
    """Draw the whole course, a close-up of its end, and each track's position error over time, as PNG.

    Parameters
    ----------
    path : Path
    title : str
    truth : Line               cov None
    tracks : sequence of Line  the same T steps; the last is drawn on top with its ellipses
    errors : str               title of the error panel
    """
    plt = pyplot()
    figure, (course, close, error) = plt.subplots(1, 3, figsize=(16, 5.2), constrained_layout=True)
    figure.suptitle(title)
    flat = truth.position.shape[1] == 1
    for axes, start in ((course, 0), (close, max(0, len(truth.position) - CLOSE_UP))):
        axes.plot(*_course(truth, start), color=truth.color, lw=2.0, label=truth.label)
        for line in tracks:
            axes.plot(*_course(line, start), ".-", ms=3, lw=0.9, color=line.color, label=line.label)
        if flat:
            axes.set(xlabel="step", ylabel="x / m")
            continue
        if start:
            for line in tracks:
                _ellipses(axes, line, start)
        axes.set_aspect("equal", "datalim")
        axes.set_xlabel("x / m")
        axes.set_ylabel("y / m")
    course.legend(loc="best", fontsize=9)
    course.set_title("course")
    ellipses = "" if flat else f", {SIGMAS:g}-sigma ellipses every {ELLIPSE_EVERY}"
    close.set_title(f"last {CLOSE_UP} steps{ellipses}")
    for line in tracks:
        error.plot(np.linalg.norm(line.position - truth.position, axis=1), color=line.color, label=line.label)
    error.set_title(errors)
    error.set_xlabel("step")
    error.set_ylabel("m")
    error.set_ylim(bottom=0)
    for axes in (course, close, error):
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _course(line: Line, start: int) -> tuple[Array, Array]:
    """Coordinates to be drawn: y over x, or of a target on a line its x over the steps."""
    position = line.position[start:]
    if position.shape[1] == 1:
        return np.arange(start, len(line.position), dtype=float), position[:, 0]
    return position[:, 0], position[:, 1]


def draw_map(path: Path, title: str, lines: Sequence[Line]) -> None:
    """Draw the positions of many targets in one plane as PNG: the first is the truth, each a set of points."""
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(10, 9), constrained_layout=True)
    for order, line in enumerate(lines):
        size, (x, y) = 1.0 if line.cov is None else 9.0 / order, line.position.T / 1e3
        axes.scatter(x, y, s=size, color=line.color, label=line.label, linewidths=0)
    axes.set_aspect("equal", "datalim")
    axes.set(title=title, xlabel="x / km", ylabel="y / km")
    axes.legend(loc="best", markerscale=3)
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _ellipses(axes: Any, line: Line, start: int) -> None:
    from matplotlib.patches import Ellipse

    if line.cov is None:
        return
    for k in range(len(line.position) - 1, start - 1, -ELLIPSE_EVERY):
        values, vectors = np.linalg.eigh(line.cov[k])
        width, height = 2.0 * SIGMAS * np.sqrt(values)
        angle = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
        axes.add_patch(Ellipse(line.position[k], width, height, angle=angle, fill=False, color=line.color, alpha=0.8))
