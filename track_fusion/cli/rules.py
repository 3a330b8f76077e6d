"""track-fusion rules: what the registry says of every rule."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click
from rich.markup import escape
from rich.table import Table

from track_fusion.cli import output
from track_fusion.params import ParameterError

if TYPE_CHECKING:
    from track_fusion.rules import Rule


@click.command(short_help="List the fusion rules, or check one against the laws.")
@click.option("--check", "name", metavar="RULE", help="Hold a rule against the laws: a key, a .py file, module:RULE.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@click.pass_context
def rules(ctx: click.Context, name: str | None, as_json: bool) -> None:
    """List every fusion rule, also of other packages: what it promises, its parameters, where it is from, its cost.

    \b
    Guarantee: conservative   the covariance is never too small, whatever the correlation of the tracks
               structural     only under the correlation structure that the rule assumes
               exact          when what it needs beyond the tracks is given
               none
    With --check it exits with 1 when the rule breaks a law.

    \b
    Examples:
      track-fusion rules
      track-fusion rules --json | jq '.[] | {key, guarantee}'
      track-fusion rules --check ./best_track.py
    """  # noqa: D301  click reads \b as "do not wrap"
    from track_fusion.rules import RULES

    if name is not None:
        ctx.exit(_check(name, as_json))
    described = []
    for key in RULES:
        try:
            described.append(describe(RULES[key]))
        except ParameterError as error:  # of another package; the rest are listed
            click.echo(str(error), err=True)
    if as_json:
        output.print_json(described, indent=2)
    else:
        _print_tables(described)


def _check(name: str, as_json: bool) -> int:
    """Hold a rule against the laws, print what became of each, and return 1 if it breaks one."""
    from track_fusion.rules import find_rule
    from track_fusion.rules.contract import check

    rule = find_rule(name)
    verdicts = list(check(rule))
    if as_json:
        output.print_json({"rule": rule.key, "laws": [verdict._asdict() for verdict in verdicts]}, indent=2)
    else:
        title = f"The laws of a fusion rule, for {rule.key}"
        report = output.table("law", "outcome", "what it says, or why not", title=title)
        for verdict in verdicts:
            report.add_row(*map(escape, verdict))
        output.console().print(report)
    return int(any(verdict.outcome == "failed" for verdict in verdicts))


def describe(rule: Rule) -> dict[str, Any]:
    """Return what the registry says of a rule, its parameters included."""
    names = ("key", "title", "family", "arity", "caveat", "order_matters", "needs",
             "needs_when", "optional", "affine_equivariant")  # fmt: skip
    return {
        **{name: getattr(rule, name) for name in names},
        "guarantee": rule.promise,
        "source": rule.source,
        "cost": rule.cost,
        "parameters": output.parameters(rule.params),
    }


def facts(rule: dict[str, Any]) -> list[tuple[str, str]]:
    """Say in words what the summary table has no room for."""
    lines = [("Guarantee", f"{rule['guarantee']}: {rule['caveat']}")]
    if rule["needs"]:
        lines.append(("Needs", ", ".join(rule["needs"])))
    for name, parameter, value in rule["needs_when"]:
        lines.append((f"Needs, with {parameter} {value}", name))
    if rule["optional"]:
        lines.append(("Can use", ", ".join(rule["optional"])))
    if rule["order_matters"]:
        when = rule["order_matters"]
        lines.append(("Order", f"the result depends on the order of the tracks{'' if when is True else f', {when}'}"))
    if rule["affine_equivariant"] is not True:
        said = rule["affine_equivariant"]
        lines.append(("Other axes or units", said if isinstance(said, str) else "give another result"))
    lines += [("Source", rule["source"]), ("Cost", rule["cost"])]
    return lines if rule["parameters"] else [*lines, ("Parameters", "none")]


def _print_tables(described: list[dict[str, Any]]) -> None:
    out = output.console()
    summary = output.table("rule", "family", "tracks", "guarantee", title=f"{len(described)} fusion rules")
    for rule in described:
        summary.add_row(*(escape(rule[name]) for name in ("key", "family", "arity", "guarantee")))
    out.print(summary)
    for rule in described:
        out.print(f"\n[bold]{rule['key']}[/bold]  {escape(rule['title'])}")
        out.print(output.grid(facts(rule)))
        if rule["parameters"]:
            out.print(_parameter_table(rule["parameters"]))


def _parameter_table(parameters: list[dict[str, Any]]) -> Table:
    shown = output.table("parameter", "default", "value", "meaning")
    for p in parameters:
        unit = f" [{p['unit']}]" if p["unit"] else ""
        cells = (p["name"], output.shown_default(p["default"]), p["wanted"] + unit, p["doc"])
        shown.add_row(*(escape(cell) for cell in cells))
    return shown
