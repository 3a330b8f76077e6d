"""track-fusion reproduce: a published study repeated by the library, measured beside published."""

from __future__ import annotations

import contextlib
import time
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from rich.table import Table

    from track_fusion.scenarios import Scenario

#: Colours of the verdicts in the table.
STYLES = {"agrees": "green", "ordering only": "yellow", "does not reproduce": "red", "not given": "dim"}


@click.command(short_help="Repeat published studies: measured beside published.")
@click.argument("names", metavar="NAME...", nargs=-1, required=True)
@click.option("--runs", type=click.IntRange(min=1), help="Monte Carlo runs.  [default: the scenario's own]")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of the random streams.")
@click.option("--only", default="", metavar="PREFIX", help="Only rows whose names start so, such as kf- (much faster).")
@click.option("--json", "as_json", is_flag=True, help="Print JSON: one object, or a list of them for several names.")
def reproduce(names: tuple[str, ...], runs: int | None, seed: int, only: str, as_json: bool) -> None:
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
      track-fusion reproduce li2022-linear --only kf- --runs 1000
      track-fusion reproduce li2022-linear --runs 1000 --seed 1 --json
    """  # noqa: D301  click reads \b as "do not wrap"
    from track_fusion.cli.output import print_json
    from track_fusion.scenarios import get_scenario

    results = []
    for scenario in [get_scenario(name) for name in dict.fromkeys(names)]:
        began = time.monotonic()
        results.append(_run(scenario, runs or scenario.default_runs, seed, only))
        if not as_json:
            _print_tables(scenario, results[-1], time.monotonic() - began)
    if as_json:
        print_json(results[0] if len(results) == 1 else results)


def _run(scenario: Scenario, runs: int, seed: int, only: str) -> dict[str, Any]:
    """Run a study under a progress bar (on a terminal); return what --json prints."""
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    from track_fusion.cli.output import console
    from track_fusion.scenarios import judged_figures

    err = console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    bar = Progress(*columns, console=err, transient=True)
    task = bar.add_task(f"{scenario.key}, {runs} runs", total=1.0)
    with bar if err.is_terminal else contextlib.nullcontext():
        measured = scenario.study(runs, seed, lambda share: bar.update(task, completed=share), only)
    return {"scenario": scenario.key, "runs": runs, "seed": seed, "figures": judged_figures(scenario, measured)}


def _print_tables(scenario: Scenario, result: dict[str, Any], took_s: float) -> None:
    """Print a table a quantity."""
    from rich.markup import escape

    from track_fusion.cli.output import console, grid

    out = console()
    out.print(f"[bold]{escape(scenario.key)}[/bold]  {escape(scenario.title)}")
    quantities = dict.fromkeys(f["name"].rpartition("/")[2] for f in result["figures"])
    for quantity in quantities:
        out.print("", _table(quantity, [f for f in result["figures"] if f["name"].rpartition("/")[2] == quantity]))
    out.print()
    facts = [("Runs", f"{result['runs']}, seed {result['seed']}, {took_s:.1f} s"), ("Paper", scenario.paper)]
    out.print(grid([*facts, *(("Assumed", a) for a in scenario.assumptions)]))


def _table(quantity: str, figures: list[dict[str, Any]]) -> Table:
    from rich.markup import escape

    from track_fusion.cli.output import table

    found = table("filter and rule", "measured", "published", "verdict", title=f"{quantity}, ± standard error")
    found.columns[1].justify = found.columns[2].justify = "right"
    for f in figures:
        measured = f"{f['value']:.4g}" if f["standard_error"] is None else rounded(f["value"], f["standard_error"])
        published = "" if f["published"] is None else f"{f['published']:g}"
        verdict = f"[{STYLES[f['verdict']]}]{f['verdict']}[/]"
        found.add_row(escape(f["name"].rpartition("/")[0]), measured, published, verdict)
    return found


def rounded(value: float, error: float) -> str:
    """Write a value and its standard error to two digits of the error."""
    from math import floor, log10

    digits = max(0, 1 - floor(log10(error))) if error > 0 else 6
    return f"{value:.{digits}f} ± {error:.{digits}f}"
