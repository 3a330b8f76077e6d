"""One picture of all rules on the same two tracks, at the four separations of Fig. 1 of Li 2022."""

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
