"""track-fusion demo: a published scenario over real ROS 2, judged beside the library and the paper."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from track_fusion.cli import output

QUANTITIES = {
    "position_armse_m": "position ARMSE / m",
    "velocity_armse_mps": "velocity ARMSE / m/s",
    "turn_rate_armse_degps": "turn rate ARMSE / deg/s",
    **{f"category_{c}_rmse_m": f"category {c.upper()}: position RMSE / m" for c in "abc"},
    **{f"category_{c}_nees_1": f"category {c.upper()}: NEES" for c in "abc"},
}


@click.command(short_help="Run a published scenario over real ROS 2 nodes.")
@click.argument("name", default="li2022-linear")
@click.option(
    "--rules",
    default=None,
    help="Fusion rules, with commas between; the last is recorded and drawn. By default some of the paper's.",
)
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0), help="Seed of the random streams.")
@click.option(
    "--runs",
    default=None,
    type=click.IntRange(min=2),
    help="Library runs to compare with; by default 1000 of Kalman filters, else those of a quick look.",
)
@click.option(
    "--out", default="out/demo", show_default=True, type=click.Path(path_type=Path), help="Where results go; replaced."
)
def demo(name: str, rules: str | None, seed: int, runs: int | None, out: Path) -> None:
    """Run a published scenario by real ROS 2 processes, with each rule, and set it beside the library and the paper.

    Replay, one tracker a sensor, the fusion centre and the evaluator run as processes of their own, in lockstep, as
    the parameter file config/NAME.yaml says; NAME is li2022-linear unless given, and `track-fusion scenarios` says
    which there are. Takes one to a few minutes. Writes a bag (mcap), figures.json and tracks.png. The verdict is on
    the many runs of the library; `track-fusion reproduce --help` says what it means.

    \b
    Examples:
      track-fusion demo li2022-linear --rules naive,arithmetic_average
      track-fusion demo li2022-nonlinear-sir
    """  # noqa: D301  click reads \b as "do not wrap"
    from track_fusion.demo.demo import run_demo
    from track_fusion.demo.plan import demo_of

    chosen = tuple(r.strip() for r in rules.split(",")) if rules else ()
    began, out_console = time.monotonic(), output.console()
    columns = (TextColumn("{task.description:32}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    planned = demo_of(name, out, seed, runs, chosen)
    with Progress(*columns, console=out_console) as bar:
        tasks: dict[str, Any] = {}

        def progress(what: str, share: float) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=1.0)
            bar.update(tasks[what], completed=share)

        result = run_demo(planned, progress)
    for shown in _tables(result, planned.row, planned.rules, planned.library_runs):
        out_console.print("", shown)
    took_s = time.monotonic() - began
    out_console.print(f"\nDone in {took_s:.0f} s: {out}/tracks.png, {out}/figures.json, {out}/bag")


def _tables(result: dict[str, Any], filter_row: str, rules: tuple[str, ...], runs: int) -> list[Table]:
    """One table a quantity: this run over ROS, the same run by the library, many library runs, published."""
    figures = {f["name"]: f for f in result["figures"]}
    tables = []
    for quantity, title in QUANTITIES.items():
        rows = [_row(figures, filter_row, row, quantity, runs) for row in ("alone", *rules)]
        if any(rows):
            of_quantity = output.table(
                "", "ROS", "library", f"{runs} runs", "paper", "verdict",
                title=f"{title} (ROS and library: the same one run)",
            )  # fmt: skip
            for column in of_quantity.columns[1:5]:
                column.justify, column.no_wrap = "right", True
            for row in filter(None, rows):
                of_quantity.add_row(*row)
            tables.append(of_quantity)
    return tables


def _row(figures: Mapping[str, Any], filter_row: str, row: str, quantity: str, runs: int) -> tuple[str, ...]:
    """Write the figures of a row; nothing where it has none over ROS."""
    from track_fusion.report.page import measured_text, published_text

    name = f"{filter_row}-{row}"
    many_name = f"{name},{runs}-runs" if "@" in name else f"{name}@{runs}-runs"
    ros, library = (figures.get(f"{path}/{name}/{quantity}") for path in ("ros", "library"))
    many = figures.get(f"library/{many_name}/{quantity}")
    if ros is None:
        return ()
    label, same = "sensor 1 alone" if row == "alone" else row, "" if library is None else f"{library['value']:.4f}"
    if many is None:
        return label, f"{ros['value']:.4f}", same, "", "", ""
    measured = measured_text(many["value"], many["standard_error"])
    return label, f"{ros['value']:.4f}", same, measured, published_text(many["published"]), many["verdict"]
