"""track-fusion compare: any rules on a published scenario, under the same noise."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import click
from rich.markup import escape

from track_fusion.cli import output
from track_fusion.params import ParameterError

if TYPE_CHECKING:
    from track_fusion.metrics.significance import Difference
    from track_fusion.scenarios import Outcomes, Scenario
    from track_fusion.study.study import RuleSpec


@click.command(short_help="Compare fusion rules on a published scenario.")
@click.argument("name", metavar="SCENARIO")
@click.option("--rules", required=True, metavar="A,B,...",
              help="Rules, with commas and no blanks between: keys, key@variant as in the rows of `track-fusion "
              "reproduce`, or Python files that define RULE.")  # fmt: skip
@click.option("--params", default="{}", metavar="JSON",
              help='Parameters, as {"covariance_intersection": {"criterion": "trace"}}.  [default: the scenario\'s '
              "own, else the rule's]")  # fmt: skip
@click.option("--runs", type=click.IntRange(min=1), help="Monte Carlo runs.  [default: the scenario's own]")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of the random streams.")
@click.option("--jobs", type=click.IntRange(min=1), help="Processes; no figure depends on it.  [default: cores]")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def compare(name: str, rules: str, params: str, runs: int | None, seed: int, jobs: int | None, as_json: bool) -> None:
    """Run fusion rules on a scenario, all under the same noise, and tell which is better by how much.

    Every quantity is one number a run, smaller is better. Differences are paired run by run; p is the two-sided
    p-value of the paired t-test, adjusted for the number of pairs by Holm's method.

    \b
    Examples:
      track-fusion compare li2022-linear --rules covariance_intersection,arithmetic_average,naive
      track-fusion compare li2022-linear --rules ./my_rule.py,covariance_intersection@uniform --runs 1000
    """  # noqa: D301  click reads \b as "do not wrap"
    from track_fusion.cli.progress import results
    from track_fusion.metrics.significance import paired_differences
    from track_fusion.scenarios import find_scenario
    from track_fusion.study.study import Study, choice

    scenario = find_scenario(name)
    if scenario.scores is None:
        raise ParameterError(f"The scenario '{scenario.key}' fuses no tracks by a rule: nothing to compare.")
    specs = rule_specs(rules, params)
    chosen = [choice(scenario, spec) for spec in specs]
    if len({c.name for c in chosen}) < len(chosen):
        raise ParameterError(f"The '--rules' must differ. Got {rules}.")
    count = (runs or scenario.default_runs) if scenario.random else 1
    (result,) = results([Study(name, find_scenario, count, seed, rules=specs)], jobs or os.cpu_count() or 1, None)
    groups = by_filter_and_quantity(result.outcomes)
    differences = {group: paired_differences(scores) for group, scores in groups.items()}
    if as_json:
        output.print_json(_as_json(scenario, count, seed, groups, differences))
    else:
        _print(scenario, count, seed, groups, differences)


def rule_specs(rules: str, params: str) -> tuple[RuleSpec, ...]:
    """Read --rules and --params.

    Raises
    ------
    ParameterError    not JSON of the right form, or parameters of a rule that is not named
    """
    from track_fusion.plugins import is_path
    from track_fusion.study.study import RuleSpec

    try:
        given = json.loads(params)
    except ValueError as error:
        raise ParameterError(f"The '--params' must be JSON. Got {params}: {error}") from None
    if not isinstance(given, dict) or not all(isinstance(values, dict) for values in given.values()):
        raise ParameterError(f"The '--params' must map rules to objects of parameters. Got {params}.")
    names = [word.strip() for word in rules.split(",") if word.strip()]
    for stranger in given.keys() - set(names):
        raise ParameterError(f"The '--params' must be of a rule in '--rules'. Got '{stranger}'.")

    def spec(word: str) -> RuleSpec:
        rule, _, variant = (word, "", "") if is_path(word) else word.partition("@")
        values = {k: tuple(v) if isinstance(v, list) else v for k, v in given.get(word, {}).items()}
        return RuleSpec(rule, tuple(sorted(values.items())), variant)

    return tuple(map(spec, names))


def by_filter_and_quantity(outcomes: Outcomes) -> dict[tuple[str, str], Outcomes]:
    """Group scores named <filter>-<rule>/<quantity>: {(filter, quantity): {rule: (R,)}}."""
    groups: dict[tuple[str, str], Outcomes] = {}
    for name, values in outcomes.items():
        row, _, quantity = name.rpartition("/")
        one, _, rule = row.partition("-")
        groups.setdefault((one, quantity), {})[rule] = values
    return groups


def _as_json(
    scenario: Scenario, runs: int, seed: int, groups: Mapping[tuple[str, str], Outcomes],
    differences: Mapping[tuple[str, str], list[Difference]],
) -> dict[str, Any]:  # fmt: skip
    from track_fusion.metrics.accuracy import Estimate

    quantities = [
        {
            "filter": one,
            "quantity": quantity,
            "rules": [
                {"rule": rule, "mean": e.value, "standard_error": e.standard_error}
                for rule, e in ((rule, Estimate.mean(values)) for rule, values in scores.items())
            ],
            "differences": [{**vars(d), "significant": d.significant} for d in differences[one, quantity]],
        }
        for (one, quantity), scores in groups.items()
    ]
    return {"scenario": scenario.key, "runs": runs, "seed": seed, "quantities": quantities}


def _print(
    scenario: Scenario, runs: int, seed: int, groups: Mapping[tuple[str, str], Outcomes],
    differences: Mapping[tuple[str, str], list[Difference]],
) -> None:  # fmt: skip
    from track_fusion.metrics.accuracy import Estimate
    from track_fusion.report.page import measured_text, quantity_text

    out = output.console()
    out.print(f"[bold]{escape(scenario.key)}[/bold]  {runs} run{'s' * (runs > 1)}, seed {seed}, smaller is better")
    for (one, quantity), scores in groups.items():
        means = output.table("rule", "mean ± standard error", title=f"{one}: {quantity_text(quantity)}")
        for rule in sorted(scores, key=lambda r: float(scores[r].mean())):
            mean = Estimate.mean(scores[rule])
            means.add_row(escape(rule), measured_text(mean.value, mean.standard_error))
        out.print("", means)
        pairs = output.table("better", "worse", "by", "p")
        for d in differences[one, quantity]:
            by = measured_text(d.mean, d.standard_error)
            style = "" if d.significant else "dim"
            pairs.add_row(escape(d.first), escape(d.second), by, _p_text(d), style=style)
        if pairs.row_count:
            out.print(pairs)


def _p_text(difference: Difference) -> str:
    if difference.mean == 0.0:
        return "equal"
    p = difference.p_value
    return "" if p != p else "< .0001" if p < 1e-4 else f"{p:.4f}"
