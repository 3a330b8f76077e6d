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

#: The demonstration's rules, in the order of the table; the last is recorded and drawn.
RULES = ("naive", "covariance_intersection", "arithmetic_average")
QUANTITIES = {"position_armse_m": "position ARMSE / m", "velocity_armse_mps": "velocity ARMSE / m/s"}


@click.command(short_help="Run a published scenario over real ROS 2 nodes.")
@click.argument("name", default="li2022-linear")
@click.option("--rules", default=",".join(RULES), show_default=True, help="Fusion rules, with commas between.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0), help="Seed of the random streams.")
@click.option(
    "--runs", default=1000, show_default=True, type=click.IntRange(min=2), help="Library runs to compare with."
)
@click.option(
    "--out", default="out/demo", show_default=True, type=click.Path(path_type=Path), help="Where results go; replaced."
)
def demo(name: str, rules: str, seed: int, runs: int, out: Path) -> None:
    """Run a published scenario by real ROS 2 processes, with each rule, and set it beside the library and the paper.

    Replay, one tracker a sensor, the fusion centre and the evaluator run as processes of their own, in lockstep,
    the fused posterior fed back to the trackers. Writes a bag (mcap), figures.json and tracks.png.

    Example: track-fusion demo li2022-linear --rules naive,arithmetic_average
    """
    from track_fusion.nodes.demo import demo_of, run_demo
    from track_fusion.nodes.managed import Fault
    from track_fusion.rules import get_rule

    chosen = tuple(get_rule(r.strip()).key for r in rules.split(","))
    began = time.monotonic()
    console = Console()
    columns = (
        TextColumn("{task.description:32}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TimeElapsedColumn(),
    )
    try:
        planned = demo_of(name, out, seed, runs, chosen)
        with Progress(*columns, console=console) as bar:
            tasks: dict[str, Any] = {}

            def progress(what: str, share: float) -> None:
                if what not in tasks:
                    tasks[what] = bar.add_task(what, total=1.0)
                bar.update(tasks[what], completed=share)

            result = run_demo(planned, progress)
    except Fault as error:
        raise click.ClickException(str(error)) from None
    for table in _tables(result, planned.rules, runs):
        console.print(table)
    console.print(
        f"Done in {time.monotonic() - began:.0f} s: {out}/tracks.png, {out}/figures.json, {out}/bag", highlight=False
    )


def _tables(result: dict[str, Any], rules: tuple[str, ...], runs: int) -> list[Table]:
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
            name = f"kf-{row}"
            many = figures[f"library/{name}@{runs}-runs/{quantity}"]
            table.add_row(
                "sensor 1 alone" if row == "alone" else row,
                f"{figures[f'ros/{name}/{quantity}']['value']:.4f}",
                f"{figures[f'library/{name}/{quantity}']['value']:.4f}",
                f"{many['value']:.2f} ± {many['standard_error']:.2f}",
                "" if many["published"] is None else f"{many['published']:.2f}",
                many["verdict"],
            )
        tables.append(table)
    return tables
