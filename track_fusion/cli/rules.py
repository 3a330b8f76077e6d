"""track-fusion rules: what the registry says of every rule."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from rich.table import Table

    from track_fusion.rules import Rule


@click.command(short_help="List the fusion rules and their parameters.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def rules(as_json: bool) -> None:
    """List every fusion rule: what it promises, when, its parameters, where it is from, what it costs.

    \b
    Guarantee: conservative   the covariance is never too small, whatever the correlation of the tracks
               structural     only under the correlation structure that the rule assumes
               exact          when what it needs beyond the tracks is given
               none

    \b
    Examples:
      track-fusion rules
      track-fusion rules --json | jq '.[] | {key, guarantee}'
    """  # noqa: D301  click reads \b as "do not wrap"
    from track_fusion.cli.output import print_json
    from track_fusion.rules import RULES

    if as_json:
        print_json([describe(rule) for rule in RULES.values()], indent=2)
    else:
        _print_tables([describe(rule) for rule in RULES.values()])


def describe(rule: Rule) -> dict[str, Any]:
    """Return what the registry says of a rule, its parameters included."""
    from track_fusion.cli.output import parameters

    names = ("key", "title", "family", "arity", "guarantee", "caveat", "order_matters", "needs",
             "needs_when", "optional", "affine_equivariant")  # fmt: skip
    return {
        **{name: getattr(rule, name) for name in names},
        "source": rule.source,
        "cost": rule.cost,
        "parameters": parameters(rule.params),
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
        lines.append(("Order", "the result depends on the order of the tracks"))
    if rule["affine_equivariant"] is not True:
        said = rule["affine_equivariant"]
        lines.append(("Other axes or units", said if isinstance(said, str) else "give another result"))
    lines += [("Source", rule["source"]), ("Cost", rule["cost"])]
    return lines if rule["parameters"] else [*lines, ("Parameters", "none")]


def _print_tables(described: list[dict[str, Any]]) -> None:
    from rich.markup import escape

    from track_fusion.cli.output import console, grid, table

    out = console()
    summary = table("rule", "family", "tracks", "guarantee", title=f"{len(described)} fusion rules")
    for rule in described:
        summary.add_row(*(escape(rule[name]) for name in ("key", "family", "arity", "guarantee")))
    out.print(summary)
    for rule in described:
        out.print(f"\n[bold]{rule['key']}[/bold]  {escape(rule['title'])}")
        out.print(grid(facts(rule)))
        if rule["parameters"]:
            out.print(_parameter_table(rule["parameters"]))


def _parameter_table(parameters: list[dict[str, Any]]) -> Table:
    from rich.markup import escape

    from track_fusion.cli.output import shown_default, table

    found = table("parameter", "default", "value", "meaning")
    for p in parameters:
        unit = f" [{p['unit']}]" if p["unit"] else ""
        cells = (p["name"], shown_default(p["default"]), p["wanted"] + unit, p["doc"])
        found.add_row(*(escape(cell) for cell in cells))
    return found
