"""track-fusion reproduce: published studies repeated by the library, measured beside published."""

from __future__ import annotations

import dataclasses
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.markup import escape

from track_fusion.cli import output

if TYPE_CHECKING:
    from rich.table import Table

    from track_fusion.report.page import Section
    from track_fusion.study.scenario import Scenario
    from track_fusion.study.study import Result, Study

#: Colours of the verdicts in the table.
STYLES = {
    "agrees": "green",
    "contradicts": "red",
    "undecided": "yellow",
    "by construction": "dim",
    "not given": "dim",
}


@click.command(short_help="Repeat published studies: measured beside published.")
@click.argument("names", metavar="NAME...", nargs=-1)
@click.option("--all", "every", is_flag=True, help="All published scenarios (under 15 minutes on two cores).")
@click.option(
    "--runs", type=click.IntRange(min=1), help="Monte Carlo runs.  [default: the scenario's own, a quick look]"
)
@click.option("--publication", is_flag=True, help="As many runs as figures to be quoted need (hours for --all).")
@click.option("--until-decided", "limit", metavar="RUNS", type=click.IntRange(min=1),
              help="Go on with more runs, up to so many, while a claim or a figure is undecided.")  # fmt: skip
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of the random streams.")
@click.option("--only", default="", metavar="PREFIX", help="Only rows whose names start so, such as kf- (much faster).")
@click.option(
    "--jobs", type=click.IntRange(min=1), help="Processes; the figures do not depend on it.  [default: cores]"
)
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default="out/reproduce", show_default=True,
              help="Where results.json and report.html, which are replaced, and finished pieces go.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print JSON: one object, or a list of them for several names.")
def reproduce(
    names: tuple[str, ...], every: bool, runs: int | None, publication: bool, limit: int | None, seed: int, only: str,
    jobs: int | None, out: Path, as_json: bool,
) -> None:  # fmt: skip
    """Run published scenarios in the library and set what was measured beside what was published.

    NAME is a scenario (`track-fusion scenarios` lists them) or a Python file that defines SCENARIO. Writes
    results.json (figures, claims, the curves of the pictures) and report.html, one page that needs nothing else.
    A run that was interrupted goes on where it was when the same command is given again. Equal seeds give equal
    figures, but for the times that ahmed-random measures. The verdicts are

    \b
      agrees            a figure within 3 standard deviations, of our runs and the paper's together;
                        a claim that holds beyond chance: 99.9 %, compared run by run
      contradicts       a figure further off (its reason may be: in the order published);
                        a claim that is false beyond chance
      undecided         these runs cannot tell: a claim within chance or on fewer than 10 runs, a
                        figure of a single run
      by construction   it agrees, but no result could contradict it; not counted as agreement
      not given         nothing to compare with

    \b
    Examples:
      track-fusion reproduce li2022-linear
      track-fusion reproduce li2022-linear --only kf- --runs 1000
      track-fusion reproduce sharma-radars --until-decided 100
      track-fusion reproduce --all --out out/all
      track-fusion reproduce ./my_scenario.py --json
    """  # noqa: D301  click reads \b as "do not wrap"
    from track_fusion.cli.progress import results
    from track_fusion.scenarios import SCENARIOS, find_scenario
    from track_fusion.study.study import Study

    if bool(names) == every:
        raise click.UsageError("Give names of scenarios, or --all.")
    if runs is not None and publication:
        raise click.UsageError("Give --runs or --publication, not both.")

    def wanted(scenario: Scenario) -> int:
        if not scenario.random:
            return scenario.default_runs
        return runs or (scenario.publication_runs if publication else scenario.default_runs)

    import matplotlib  # noqa: F401  the page needs it: better missing now than after the work

    chosen = tuple(SCENARIOS) if every else tuple(dict.fromkeys(names))
    studies = [Study(name, find_scenario, wanted(find_scenario(name)), seed, only) for name in chosen]
    sections = []
    run = partial(results, jobs=jobs or os.cpu_count() or 1, store=out / "pieces", told=True)
    for section in map(_section, run(studies)) if limit is None else _until_decided(studies, limit, run):
        sections.append(section)
        if not as_json:
            _print_tables(sections[-1])
    _write(out, sections)
    if as_json:
        answers = [section.result for section in sections]
        output.print_json(answers[0] if len(answers) == 1 else answers)
    else:
        click.echo(f"Written: {out / 'report.html'}, {out / 'results.json'}")


def _until_decided(
    studies: Sequence[Study], limit: int, run: Callable[[Sequence[Study]], Iterator[Result]]
) -> Iterator[Section]:
    """Run each study with ever more runs, at most so many, until no verdict is undecided; what is done is kept."""
    for study in studies:
        (result,) = run([study])
        section = _section(result)
        while section.scenario.random and study.runs < limit and _is_undecided(section):
            pieces = ceil(2 * study.runs / section.scenario.piece)
            study = dataclasses.replace(study, runs=min(pieces * section.scenario.piece, limit))
            (result,) = run([study])
            section = _section(result)
        yield section


def _is_undecided(section: Section) -> bool:
    return any(judged["verdict"] == "undecided" for key in ("claims", "figures") for judged in section.result[key])


def _section(result: Result) -> Section:
    """Judge a study: what --json prints, and what goes with it on the page."""
    from track_fusion.report.page import Section
    from track_fusion.scenarios import find_scenario
    from track_fusion.study.judgement import judged_claims, judged_figures

    study, scenario = result.study, find_scenario(result.study.scenario)
    measured = scenario.figures(result.outcomes)
    answer = {
        "scenario": scenario.key,
        "runs": study.runs,
        "seed": study.seed,
        "figures": judged_figures(scenario, measured),
        "claims": judged_claims(scenario, measured),
    }
    return Section(answer, scenario, scenario.charts(result.outcomes), result.took_s)


def _write(out: Path, sections: Sequence[Section]) -> None:
    """Write results.json, which is the same whenever the figures are, and report.html."""
    import numpy as np

    from track_fusion.cli.app import version
    from track_fusion.report.page import page

    content = [{**output.plain(s.result), "charts": output.plain(s.charts)} for s in sections]
    (out / "results.json").write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    made = f"track_fusion {version()}, NumPy {np.__version__}, {time.strftime('%Y-%m-%d %H:%M')}"
    (out / "report.html").write_text(page(sections, made), encoding="utf-8")


def _print_tables(section: Section) -> None:
    """Print a table a quantity, then the claims."""
    from track_fusion.report.page import assumption_text, by_quantity, evidence_text, unpublished

    out, (result, scenario, _, took_s) = output.console(), section
    out.print(f"[bold]{escape(scenario.key)}[/bold]  {escape(scenario.title)}")
    groups = by_quantity(result["figures"])
    folded = unpublished(groups)
    for quantity, figures in groups.items():
        if quantity not in folded:
            out.print("", _table(quantity, figures))
    if folded:
        out.print(f"\n{sum(len(groups[q]) for q in folded)} figures with nothing published: see report.html")
    if result["claims"]:
        claims = output.table("claim", "verdict", title="claims")
        for c in result["claims"]:
            claims.add_row(escape(f"{c['claim']} ({evidence_text(c['evidence'])})"), _verdict(c))
        out.print("", claims)
    out.print()
    facts = [
        ("Runs", f"{result['runs']}, seed {result['seed']}, {took_s:.1f} s of one processor"),
        ("Paper", scenario.paper),
    ]
    out.print(output.grid([*facts, *(("Assumed", assumption_text(a)) for a in scenario.assumptions)]))


def _table(quantity: str, figures: Sequence[Mapping[str, Any]]) -> Table:
    from track_fusion.report.page import measured_text, published_text, quantity_text

    title = f"{quantity_text(quantity)}, ± standard error"
    compared = output.table("filter and rule", "measured", "published", "verdict", title=title)
    compared.columns[1].justify = compared.columns[2].justify = "right"
    for f in figures:
        measured = measured_text(f["value"], f["standard_error"])
        compared.add_row(escape(f["name"].rpartition("/")[0]), measured, published_text(f["published"]), _verdict(f))
    return compared


def _verdict(judged: Mapping[str, Any]) -> str:
    from track_fusion.report.page import verdict_text

    return f"[{STYLES[judged['verdict']]}]{escape(verdict_text(judged))}[/]"
