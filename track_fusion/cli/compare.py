"""track-fusion compare: any rules on a published scenario, under the same noise."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import click
from rich.markup import escape

from track_fusion.cli import output
from track_fusion.params import ParameterError

if TYPE_CHECKING:
    from rich.table import Table

    from track_fusion.metrics.significance import Difference
    from track_fusion.study.comparison import Group, Score
    from track_fusion.study.rows import Outcomes
    from track_fusion.study.scenario import Scenario
    from track_fusion.study.study import RuleSpec

#: What the numbers of a group are, where smaller is not better.
NOTES = {"error": "", "claimed": " (what is claimed, neither good nor bad)", "consistency": " (1 is right)"}


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

    Every quantity is one number a run; of errors smaller is better, of consistency (squared error over its claim) 1 is
    right, and what a rule claims is neither good nor bad. Differences of errors are paired run by run; p is the
    two-sided p-value of the paired t-test, adjusted by Holm's method for all pairs of all quantities. Where nothing is
    random there is no p. A run has diverged whose error is not finite or ten times the median of the best rule; a rule
    that diverges is never significantly better.

    \b
    Examples:
      track-fusion compare li2022-linear --rules covariance_intersection,arithmetic_average,naive
      track-fusion compare li2022-linear --rules ./my_rule.py,covariance_intersection@uniform --runs 1000
    """  # noqa: D301  click reads \b as "do not wrap"
    from track_fusion.cli.progress import results
    from track_fusion.scenarios import find_scenario
    from track_fusion.study.comparison import grouped
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
    groups = grouped(result.outcomes)
    conservative = [c.name for c in chosen if c.rule.guarantee_at(c.params) == "conservative"]
    if as_json:
        output.print_json(_as_json(scenario, count, seed, groups, conservative))
    else:
        _print(scenario, count, seed, groups, conservative)


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


def _as_json(
    scenario: Scenario, runs: int, seed: int, groups: Mapping[Group, Outcomes], conservative: Sequence[str]
) -> dict[str, Any]:
    from track_fusion.study.comparison import differences, scores

    pairs, rules = differences(groups), scores(groups, conservative)
    quantities = [
        {
            "filter": group.filter,
            "quantity": group.quantity,
            "kind": group.kind,
            "rules": [_score_json(score) for score in rules[group]],
            "differences": [{**vars(d), "significant": d.significant} for d in pairs.get(group, [])],
        }
        for group in groups
    ]
    return {"scenario": scenario.key, "runs": runs, "seed": seed, "quantities": quantities}


def _score_json(score: Score) -> dict[str, Any]:
    described = {
        "rule": score.rule,
        "mean": score.mean.value,
        "standard_error": score.mean.standard_error,
        "robust_mean": score.robust_mean,
        "diverged": score.diverged,
    }
    if score.distance is None:
        return described
    return described | {"distance": score.distance, "consistency": score.consistency}


def _print(
    scenario: Scenario, runs: int, seed: int, groups: Mapping[Group, Outcomes], conservative: Sequence[str]
) -> None:
    from track_fusion.study.comparison import differences, scores

    out, pairs = output.console(), differences(groups)
    out.print(f"[bold]{escape(scenario.key)}[/bold]  {runs} run{'s' * (runs > 1)}, seed {seed}, smaller is better")
    for group, rules in scores(groups, conservative).items():
        out.print("", _scores_table(group, rules))
        if pairs.get(group):
            out.print(_pairs_table(pairs[group]))


def _scores_table(group: Group, rules: Sequence[Score]) -> Table:
    """Means, and where there is something to say of it the share of diverged runs, or consistency."""
    from track_fusion.report.page import measured_text, quantity_text

    title = f"{group.filter}: {quantity_text(group.quantity)}{NOTES[group.kind]}"
    extra = {
        "robust mean": [f"{s.robust_mean:.5g}" for s in rules] if any(s.diverged for s in rules) else [],
        "diverged": [f"{s.diverged:.1%}" for s in rules] if any(s.diverged for s in rules) else [],
        "consistency": [s.consistency for s in rules] if group.kind == "consistency" else [],
    }
    extra = {name: cells for name, cells in extra.items() if cells}
    means = output.table("rule", "mean ± standard error", *extra, title=title)
    for i in sorted(range(len(rules)), key=lambda i: _place(rules[i])):
        mean = rules[i].mean
        cells = (column[i] for column in extra.values())
        means.add_row(escape(rules[i].rule), measured_text(mean.value, mean.standard_error), *cells)
    return means


def _place(score: Score) -> float:
    place = score.mean.value if score.distance is None else score.distance
    return place if place - place == 0.0 else float("inf")


def _pairs_table(differences: Sequence[Difference]) -> Table:
    from track_fusion.report.page import measured_text

    pairs = output.table("better", "worse", "by", "p")
    for d in differences:
        by = measured_text(d.mean, d.standard_error)
        p = "diverges" if d.diverges else _p_text(d)
        pairs.add_row(escape(d.first), escape(d.second), by, p, style="" if d.significant else "dim")
    return pairs


def _p_text(difference: Difference) -> str:
    if difference.mean == 0.0:
        return "equal"
    p = difference.p_value
    return "" if p != p else "< .0001" if p < 1e-4 else f"{p:.4f}"
