"""track-fusion reproduce: a published study repeated by the library, measured beside published."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from track_fusion.scenarios import Scenario

#: Colours of the verdicts in the table.
STYLES = {"agrees": "green", "ordering only": "yellow", "does not reproduce": "red", "not given": "dim"}


@click.command(short_help="Repeat published studies: measured beside published.")
@click.argument("names", metavar="NAME...", nargs=-1, required=True)
@click.option("--runs", type=click.IntRange(min=1), help="Monte Carlo runs.  [default: the scenario's own]")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of the random streams.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON: one object, or a list of them for several names.")
def reproduce(names: tuple[str, ...], runs: int | None, seed: int, as_json: bool) -> None:
    """Run published scenarios in the library and set what was measured beside what was published.

    Equal seeds give equal figures. The verdict on a figure is

    \b
      agrees               the difference is within 3 standard deviations, of our runs and the paper's together
      ordering only        the figure stands to the others of its table as published
      does not reproduce   neither
      not given            nothing to compare with, or a single run, whose error is unknown

    \b
    Examples:
      track-fusion reproduce li2022-linear
      track-fusion reproduce li2022-linear --runs 1000 --seed 1 --json
    """  # noqa: D301  click reads \b as "do not wrap"
    from track_fusion.cli.output import print_json
    from track_fusion.scenarios import get_scenario

    results = []
    for scenario in [get_scenario(name) for name in dict.fromkeys(names)]:
        began = time.monotonic()
        results.append(_run(scenario, runs or scenario.default_runs, seed))
        if not as_json:
            _print_table(scenario, results[-1], time.monotonic() - began)
    if as_json:
        print_json(results[0] if len(results) == 1 else results)


def _run(scenario: Scenario, runs: int, seed: int) -> dict[str, Any]:
    """Run a study under a progress bar (on a terminal); return what --json prints."""
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    from track_fusion.cli.output import console
    from track_fusion.scenarios import figures

    err = console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as bar:
        task = bar.add_task(f"{scenario.key}, {runs} runs", total=1.0)
        measured = scenario.study(runs, seed, lambda share: bar.update(task, completed=share))
    return {"scenario": scenario.key, "runs": runs, "seed": seed, "figures": figures(scenario, measured)}


def _print_table(scenario: Scenario, result: dict[str, Any], took_s: float) -> None:
    from rich.markup import escape
    from rich.table import Table

    from track_fusion.cli.output import console

    table = Table(title=f"{escape(scenario.key)}: {escape(scenario.title)}")
    table.add_column("figure", no_wrap=True)
    table.add_column("measured ± standard error", justify="right")
    table.add_column("published", justify="right")
    table.add_column("verdict")
    for figure in result["figures"]:
        error, published, verdict = (figure[name] for name in ("standard_error", "published", "verdict"))
        measured = f"{figure['value']:.4g}" if error is None else rounded(figure["value"], error)
        table.add_row(
            escape(figure["name"]),
            measured,
            "" if published is None else f"{published:g}",
            f"[{STYLES[verdict]}]{verdict}[/]",
        )
    out = console()
    out.print(table)
    out.print(f"{result['runs']} runs, seed {result['seed']}, {took_s:.1f} s. {escape(scenario.paper)}.")
    for assumption in scenario.assumptions:
        out.print(f"Assumed: {escape(assumption)}.")


def rounded(value: float, error: float) -> str:
    """Write a value and its standard error to two digits of the error."""
    from math import floor, log10

    digits = max(0, 1 - floor(log10(error))) if error > 0 else 6
    return f"{value:.{digits}f} ± {error:.{digits}f}"
