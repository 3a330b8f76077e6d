"""Draw charts as SVG."""

from __future__ import annotations

import io
from itertools import cycle
from typing import Any

import numpy as np

from track_fusion.study.chart import Chart, Contours, Series

#: Inches; one chart is a column of a narrow screen.
WIDTH, HEIGHT, LEGEND_ROW = 5.2, 3.7, 0.22
LINE_STYLES = {"line": "-", "dashed": "--", "dotted": ":", "steps": "-"}
#: More lines than this have their legend below the panel.
LEGEND_INSIDE = 5
#: Longer labels, in characters, take a row of the legend each.
LABEL_OF_HALF_WIDTH = 34


def pyplot() -> Any:
    """Import matplotlib only when something is drawn, and without a display."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def svg(chart: Chart) -> str:
    """Return a chart as an SVG document; equal charts give equal text."""
    plt = pyplot()
    with plt.rc_context({"svg.hashsalt": "track_fusion", "svg.fonttype": "none", "font.size": 11}):
        figure, axes = plt.subplots(figsize=(WIDTH, HEIGHT), layout="constrained")
        try:
            draw_chart(axes, chart)
            _legend(figure, axes)
            out = io.StringIO()
            figure.savefig(out, format="svg", metadata={"Date": None})
        finally:
            plt.close(figure)
    text = out.getvalue()
    return text[text.index("<svg") :]


def draw_chart(axes: Any, chart: Chart) -> None:
    """Draw a chart into axes of matplotlib."""
    colors = cycle([f"C{i}" for i in range(10)])
    bars = [s for s in chart.series if s.style == "bars"]
    for series in chart.series:
        _series(axes, series, next(colors), bars)
    for contours in chart.contours:
        _contours(axes, contours, next(colors))
    if chart.log_x:
        axes.set_xscale("log")
    if chart.log_y:
        axes.set_yscale("log")
    if chart.equal:
        axes.set_aspect("equal", "datalim")
    if chart.ticks:
        turned = sum(map(len, chart.ticks.values())) > 40  # else they would run into each other
        axes.set_xticks(list(chart.ticks), list(chart.ticks.values()), rotation=30 if turned else 0,
                        ha="right" if turned else "center")  # fmt: skip
    axes.set(xlabel=chart.x_label, ylabel=chart.y_label)
    axes.set_title(chart.title, fontsize=11, wrap=True)
    axes.grid(alpha=0.3)


def _series(axes: Any, series: Series, color: str, bars: list[Series]) -> None:
    x, y = np.asarray(series.x, float), np.asarray(series.y, float)
    label = series.label or None
    if series.style == "bars":
        width = 0.8 / len(bars)
        at = x + (next(i for i, s in enumerate(bars) if s is series) - 0.5 * (len(bars) - 1)) * width
        axes.bar(at, y, width, color=color, label=label, yerr=series.error, capsize=2)
    elif series.style == "points":
        axes.errorbar(x, y, series.error, fmt="o", ms=4, color=color, label=label)
    else:
        where = "steps-post" if series.style == "steps" else "default"
        axes.plot(x, y, LINE_STYLES[series.style], lw=1.4, color=color, label=label, drawstyle=where)
        if series.error is not None:
            axes.fill_between(x, y - series.error, y + series.error, color=color, alpha=0.2, lw=0)


def _contours(axes: Any, contours: Contours, color: str) -> None:
    axes.contour(contours.x, contours.y, contours.z, levels=list(contours.levels), colors=color, linewidths=1.1)
    axes.plot([], [], color=color, label=contours.label or None)


def _legend(figure: Any, axes: Any) -> None:
    """Few labels stand inside the panel, many below it."""
    handles, labels = axes.get_legend_handles_labels()
    if len(labels) > LEGEND_INSIDE:
        columns = 2 if max(map(len, labels)) <= LABEL_OF_HALF_WIDTH else 1
        figure.set_figheight(HEIGHT + LEGEND_ROW * -(-len(labels) // columns))
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize=9, frameon=False)
    elif labels:
        axes.legend(handles, labels, fontsize=9)
