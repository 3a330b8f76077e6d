"""Pictures for the pages: all rules on the same two tracks, as in Fig. 1 of Li 2022; ghosts with and without links."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from track_fusion.linalg import Array
from track_fusion.rules import Rule
from track_fusion.scenarios.li2022.four_cases import SEPARATIONS, enough_for_two, two_tracks
from track_fusion.study.chart import ellipse

RULES_A_PANEL = 5
COLORS = ("tab:blue", "tab:red", "tab:green", "tab:purple", "tab:orange")


def draw_rules(path: Path) -> list[str]:
    """Draw every rule with its default parameters; return the keys drawn.

    One column a separation; rows of at most five rules, one colour each; the two tracks dashed; ellipses of one
    standard deviation.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    rules = enough_for_two()
    groups = [rules[i : i + RULES_A_PANEL] for i in range(0, len(rules), RULES_A_PANEL)]
    shape = len(groups), len(SEPARATIONS)
    figure, panels = plt.subplots(*shape, figsize=(15, 2.9 * len(groups)), constrained_layout=True, squeeze=False)
    for row, group in zip(panels, groups, strict=True):
        for axes, separation in zip(row, SEPARATIONS.values(), strict=True):
            _panel(axes, group, separation)
        row[-1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=9, frameon=False)
    for axes, (letter, separation) in zip(panels[0], SEPARATIONS.items(), strict=True):
        axes.set_title(f"({letter}) means {separation:g} apart along x")
    figure.savefig(path, dpi=100)
    plt.close(figure)
    return [rule.key for rule in rules]


def draw_ghosts(path: Path) -> None:
    """Draw how many tracks too many a centre publishes over time, with one gate of 99 % and with its defaults.

    Twenty targets 3 m apart, two consistent Kalman trackers, one colour a standard deviation of the second one's
    measurements.
    """
    import matplotlib

    matplotlib.use("Agg")
    import numpy as np
    from matplotlib import pyplot as plt

    from benchmark.identity import PERIOD_S, score, side_by_side, single_gate

    centres = {"one gate of 99 %": single_gate(0.99), "links, patience, duplicates (the defaults)": {}}
    figure, panels = plt.subplots(1, len(centres), figsize=(11, 3.2), sharey=True, constrained_layout=True)
    for sd, color in zip((1.0, 2.0, 4.0, 8.0), COLORS, strict=False):
        scene = side_by_side(np.random.default_rng(0), False, (1.0, sd), spacing_m=3.0, seconds=60.0)
        for axes, (name, params) in zip(panels, centres.items(), strict=True):
            result = score(scene, **params)
            time_s = PERIOD_S * np.arange(len(result.published))
            extra = np.maximum(result.published - result.living, 0)
            axes.step(time_s, extra, color=color, lw=1.0, label=f"sd 1 and {sd:g} m: {result.ghosts:.0%} of steps")
            axes.set_title(name)
            axes.set_xlabel("time [s]")
    panels[0].set_ylabel("tracks too many")
    for axes in panels:
        axes.set_ylim(-0.1, 4.5)  # room for the legend
        axes.legend(fontsize=8, loc="upper right")
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _panel(axes: Any, group: Sequence[Rule], separation: float) -> None:
    tracks = two_tracks(separation)
    for mean, cov in zip(tracks.mean, tracks.cov, strict=True):
        _outline(axes, mean, cov, "--", color="0.4", lw=1.0)
        axes.plot(*mean, "+", color="0.4")
    for rule, color in zip(group, COLORS, strict=False):
        fused = rule(tracks)
        _outline(axes, fused.mean, fused.cov, color=color, lw=1.5, label=rule.key)
        axes.plot(*fused.mean, ".", color=color)
    axes.set_aspect("equal", "datalim")
    axes.tick_params(labelsize=7)


def _outline(axes: Any, mean: Array, cov: Array, *style: str, **looks: Any) -> None:
    line = ellipse("", mean, cov, sigmas=1.0)
    axes.plot(line.x, line.y, *style, **looks)
