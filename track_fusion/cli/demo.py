"""track-fusion demo: a published scenario over real ROS 2, judged beside the library and the paper."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import click
from rich import box
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

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
    began = time.monotonic()
    console = Console()
    columns = (
        TextColumn("{task.description:32}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TimeElapsedColumn(),
    )
    planned = demo_of(name, out, seed, runs, chosen)
    with Progress(*columns, console=console) as bar:
        tasks: dict[str, Any] = {}

        def progress(what: str, share: float) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=1.0)
            bar.update(tasks[what], completed=share)

        result = run_demo(planned, progress)
    for table in _tables(result, planned.row, planned.rules, planned.library_runs):
        console.print(table)
    console.print(
        f"Done in {time.monotonic() - began:.0f} s: {out}/tracks.png, {out}/figures.json, {out}/bag", highlight=False
    )


def _tables(result: dict[str, Any], filter_row: str, rules: tuple[str, ...], runs: int) -> list[Table]:
    """One table a quantity: this run over ROS, the same run by the library, many library runs, published."""
    figures = {f["name"]: f for f in result["figures"]}
    tables = []
    for quantity, title in QUANTITIES.items():
        table = Table(
            title=f"{title} (ROS and library: the same one run)", box=box.SIMPLE, pad_edge=False, padding=(0, 1, 0, 0)
        )
        table.add_column("", no_wrap=True)
        for column in ("ROS", "library", f"{runs} runs", "paper"):
            table.add_column(column, justify="right", no_wrap=True)
        table.add_column("verdict", min_width=12)
        for row in ("alone", *rules):
            name = f"{filter_row}-{row}"
            many_name = f"{name},{runs}-runs" if "@" in name else f"{name}@{runs}-runs"
            single = [figures.get(f"{path}/{name}/{quantity}") for path in ("ros", "library")]
            many = figures.get(f"library/{many_name}/{quantity}")
            if single[0] is None:
                continue
            error = "" if many is None or many["standard_error"] is None else f" ± {many['standard_error']:.2f}"
            table.add_row(
                "sensor 1 alone" if row == "alone" else row,
                *("" if f is None else f"{f['value']:.4f}" for f in single),
                "" if many is None else f"{many['value']:.2f}{error}",
                "" if many is None or many["published"] is None else f"{many['published']:.2f}",
                "" if many is None else many["verdict"],
            )
        if table.row_count:
            tables.append(table)
    return tables
