"""Write the files of this repository that are made from the rules and the parameter dataclasses: `make docs`.

.venv/bin/python -m tools.docs [--check] [--picture]
"""

from __future__ import annotations

import dataclasses
import json
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from track_fusion.params import Params, Spec, specs
from track_fusion.plugins import Registry

if TYPE_CHECKING:
    from track_fusion.models.choices import Choice
    from track_fusion.study.claim import Claim
    from track_fusion.study.scenario import Scenario

SOURCE_TREE = Path(__file__).parents[1]
LINE_WIDTH = 120


class Section(NamedTuple):
    """Parameters that a node declares together."""

    params: type[Params]
    prefix: str = ""
    title: str = ""  # in place of the first line of the dataclass's docstring
    declared: bool = True  # false: only when another choice is made; its lines are comments

    @property
    def heading(self) -> str:
        """The title, or the first line of the dataclass's docstring."""
        return self.title or (self.params.__doc__ or "").strip().splitlines()[0]


@click.command()
@click.option("--check", is_flag=True, help="Write nothing; exit with 1 when a file differs.")
@click.option("--picture", is_flag=True, help="Draw doc/rules.png, too (needs matplotlib).")
@click.option(
    "--root", default=SOURCE_TREE, type=click.Path(path_type=Path, file_okay=False), help="The source tree.",
)  # fmt: skip
@click.pass_context
def docs(ctx: click.Context, check: bool, picture: bool, root: Path) -> None:
    """Write doc/rules.md, doc/scenarios.md, the tables of other pages in doc/ and the parameter files of config/.

    They are made from the registries of rules and scenarios, the parameter dataclasses and the rooms of tools/house.py,
    and change with them.
    Needs ROS 2.
    """
    if not (root / "package.xml").is_file():
        raise click.UsageError(f"--root: {root} is no source tree of track_fusion, it has no package.xml.")
    if picture:
        from tools.gallery import draw_ghosts, draw_rules

        (root / "doc").mkdir(exist_ok=True)
        click.echo(f"Drew {len(draw_rules(root / 'doc' / 'rules.png'))} rules in doc/rules.png")
        draw_ghosts(root / "doc" / "ghosts.png")
        click.echo("Drew doc/ghosts.png")
    differing = []
    for name, text in generated().items():
        path = root / name
        if path.is_file() and path.read_text(encoding="utf-8") == text:
            continue
        differing.append(name)
        if not check:
            path.parent.mkdir(exist_ok=True)
            path.write_text(text, encoding="utf-8")
            click.echo(f"Wrote {name}")
    if check and differing:
        click.echo(f"Out of date: {', '.join(differing)}. Run: make docs", err=True)
        ctx.exit(1)
    if not differing:
        click.echo("All generated files are up to date.")


def generated() -> dict[str, str]:
    """Return the text of each generated file by its path in the source tree."""
    return {
        "doc/rules.md": rules_page(),
        "doc/choosing-a-rule.md": choosing_page(),
        "doc/scenarios.md": scenarios_page(),
        "doc/architecture.md": architecture_page(),
        "config/fusion_centre.yaml": parameter_file("fusion_centre", fusion_centre_sections()),
        "config/sensor_tracker.yaml": parameter_file("sensor_tracker", sensor_tracker_sections()),
    }


# The pages.

_TABLE = re.compile(r"(<!-- begin: [^\n]*-->\n).*(<!-- end -->)", re.DOTALL)


def choosing_page() -> str:
    """Return doc/choosing-a-rule.md, written by hand but for its table of promises."""
    from track_fusion.rules import RULES

    rows = [(f"[`{r.key}`](rules.md#{r.key})", r.promise, r.caveat, r.cost, r.source) for r in RULES.own.values()]
    return _filled("choosing-a-rule.md", _table(("rule", "promise", "when, or what breaks it", "cost", "source"), rows))


def architecture_page() -> str:
    """Return doc/architecture.md, written by hand but for its table of rooms."""
    from tools.house import FLOORS

    height = len(FLOORS) - 1
    rows = [(str(height - k), f"`{name}`", what) for k, rooms in enumerate(FLOORS) for name, what in rooms.items()]
    return _filled("architecture.md", _table(("floor", "room", "what is in it"), rows))


def _filled(name: str, table: str) -> str:
    """Put a table between the two marks of a page in doc/."""
    text = (SOURCE_TREE / "doc" / name).read_text(encoding="utf-8")
    return _TABLE.sub(lambda marks: f"{marks[1]}{table}\n{marks[2]}", text)


def rules_page() -> str:
    """Return doc/rules.md."""
    from track_fusion.cli.rules import describe
    from track_fusion.rules import RULES

    described = [describe(rule) for rule in RULES.own.values()]
    columns = ("rule", "family", "tracks", "guarantee", "source", "cost")
    rows = [(f"[`{r['key']}`](#{r['key']})", r["family"], r["arity"], r["guarantee"], r["source"], r["cost"])
            for r in described]  # fmt: skip
    parts = [
        "<!-- Generated by `make docs`. Do not edit: change the rules in track_fusion/rules/. -->",
        "# Fusion rules",
        "What `state_fusion` of the fusion centre and `--rule` of `track-fusion fuse` may be. Cost: operations a "
        "fusion, in K tracks of n axes.",
        _table(columns, rows),
        "**conservative**: the fused covariance is never too small, whatever the cross-correlation of the tracks, at "
        "weights that do not depend on the means. **structural**: only under the correlation structure that the rule "
        "assumes. **exact**: when what it needs beyond the tracks is given. **none**: no promise. "
        "**n_ary** rules fuse any number of tracks at once; **pairwise** ones fuse one after the other.",
        *(_rule_section(r) for r in described),
    ]
    return "\n\n".join(parts) + "\n"


def _rule_section(rule: dict[str, Any]) -> str:
    from track_fusion.cli.output import shown_default
    from track_fusion.cli.rules import facts

    parts = [f"## {rule['key']}", f"{rule['title']}.", "\n".join(f"* {name}: {text}" for name, text in facts(rule))]
    if not rule["parameters"]:
        return "\n\n".join(parts)
    rows = [
        (f"`{p['name']}`", f"`{shown_default(p['default'])}`", p["wanted"] + (f" [{p['unit']}]" if p["unit"] else ""),
         p["doc"])
        for p in rule["parameters"]
    ]  # fmt: skip
    return "\n\n".join([*parts, _table(("parameter", "default", "value", "meaning"), rows)])


def scenarios_page() -> str:
    """Return doc/scenarios.md."""
    from track_fusion.demo.wiring import demos_of
    from track_fusion.scenarios import SCENARIOS

    rows = [(f"[`{s.key}`](#{s.key})", s.title, "yes" if demos_of(s.key) else "") for s in SCENARIOS.values()]
    parts = [
        "<!-- Generated by `make docs`. Do not edit: change the scenarios in track_fusion/scenarios/. -->",
        "# Published scenarios",
        "What `track-fusion reproduce`, `compare` and, where it says so, `demo` (over ROS 2) run. Claims are what a "
        "paper says beyond single figures; `reproduce` judges each: agrees, contradicts or undecided, and a claim that "
        "no result could contradict is by construction and counts for nothing. Assumed is what the paper leaves open.",
        _table(("scenario", "what", "over ROS"), rows),
        *map(_scenario_section, SCENARIOS.values()),
    ]
    return "\n\n".join(parts) + "\n"


def _scenario_section(scenario: Scenario) -> str:
    from track_fusion.demo.wiring import demos_of
    from track_fusion.report.page import assumption_text

    demos = ", ".join(f"`track-fusion demo {name}`" for name in demos_of(scenario.key))
    runs = f"* Runs: {scenario.default_runs} by default, {scenario.publication_runs} for figures to be quoted, "
    facts = [
        f"* Shows: {scenario.shows}",
        f"* Paper: {scenario.paper}; {len(scenario.published)} figures printed",
        f"{runs}{scenario.published_runs} in the paper" if scenario.random else "* Nothing in it is random.",
        *([f"* Over ROS: {demos}"] if demos else []),
        *(f"* Claim: {claim.text} ({claim.source}){_reservation(claim)}" for claim in scenario.claims),
        *(f"* Assumed: {assumption_text(text)}" for text in scenario.assumptions),
    ]
    return "\n\n".join([f"## {scenario.key}", f"{scenario.title}.", "\n".join(facts)])


def _reservation(claim: Claim) -> str:
    return f"; by construction: {claim.by_construction}" if claim.by_construction else ""


def _table(columns: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    lines = [tuple(columns), *(tuple(cell.replace("|", "\\|") for cell in row) for row in rows)]
    lines.insert(1, ("---",) * len(lines[0]))
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


# The parameter files.


def fusion_centre_sections() -> list[Section]:
    """List what the fusion centre declares; a test compares it with the node."""
    from track_fusion.centre.config import (
        TRACK_RULES,
        FusionCentreParams,
        IdentityParams,
        ScanBufferParams,
        SourceSettings,
        StateFusionParams,
        TrackManagerParams,
    )
    from track_fusion.clock import ClockParams
    from track_fusion.messages.centre import OneSourceParams, SourceParams
    from track_fusion.messages.parameters import ManagedParams
    from track_fusion.messages.screening import FrameParams
    from track_fusion.models.choices import MOTIONS, MotionChoice
    from track_fusion.random_streams import RandomParams

    default, declared = StateFusionParams().state_fusion, "declared when state_fusion is"
    rules = {key: rule for key, rule in TRACK_RULES.own.items() if specs(rule.params)}
    return [
        *map(Section, (FrameParams, SourceParams)),
        *(
            Section(kind, f"{name}.", title and f"{title} {name}.")
            for name in SourceParams().source_configurations
            for kind, title in ((OneSourceParams, "The source"), (SourceSettings, "What is declared of"))
        ),
        Section(MotionChoice),
        *_alternatives("motion", MOTIONS.own, MotionChoice().motion),
        *map(Section, (StateFusionParams, FusionCentreParams)),
        *(
            Section(rule.params, f"{key}.", f"{rule.title}: {declared} {key}.", declared=key == default)
            for key, rule in rules.items()
        ),
        *map(Section, (ScanBufferParams, TrackManagerParams, IdentityParams)),
        Section(RandomParams, title="Random numbers of rules that draw samples: seed, run and role name a stream."),
        Section(ClockParams),
        Section(ManagedParams),
    ]


def sensor_tracker_sections() -> list[Section]:
    """List what a sensor tracker declares; a test compares it with the node."""
    from track_fusion.clock import ClockParams
    from track_fusion.messages.parameters import ManagedParams
    from track_fusion.messages.screening import FrameParams
    from track_fusion.models.choices import MOTIONS, SENSORS, Choice
    from track_fusion.nodes.sensor_tracker import FeedbackParams, OutputParams
    from track_fusion.trackers.filters import FILTERS
    from track_fusion.trackers.many_targets import PdaTracker, PdaTrackerParams
    from track_fusion.trackers.one_target import MULTI_TARGET, SensorTrackerParams, TrackerChoice

    default = TrackerChoice()
    filters: dict[str, Choice[Any]] = {**FILTERS, MULTI_TARGET: Choice(PdaTrackerParams, PdaTracker)}
    return [
        *map(Section, (FrameParams, TrackerChoice)),
        *_alternatives("motion", MOTIONS.own, default.motion),
        *_alternatives("sensor", SENSORS, default.sensor),
        *_alternatives("filter", filters, default.filter),
        *map(Section, (SensorTrackerParams, FeedbackParams, OutputParams, ClockParams, ManagedParams)),
    ]


def _alternatives(name: str, table: Mapping[str, Choice[Any]], default: str) -> Iterator[Section]:
    """Describe the parameters of each entry of a table of choices; a node declares those of one."""
    for key, choice in table.items():
        if specs(choice.params):
            title = f"{Section(choice.params).heading} Declared when {name} is {key}."
            yield Section(choice.params, title=title, declared=key == default)


def parameter_file(node: str, sections: Iterable[Section]) -> str:
    """Return a parameter file for a node, every parameter at its default, with meaning, unit and range."""
    head = [
        f"Every parameter of the {node} node at its default. Copy this file, keep the lines you change, and run",
        f"    ros2 run track_fusion {node} --ros-args --params-file <your copy>",
        f"The name below is that of the node: change it when you give the node another (-r __node:={node}_2).",
        "Axes are quoted: a bare y is YAML for true.",
        "Generated by `make docs` from the parameter dataclasses: change those.",
    ]
    lines = [*_comment(head, ""), f"{node}:", "  ros__parameters:"]
    lines += ["    # take the time from /clock, as a simulation or a replayed bag needs it (true or false)"]
    lines += ["    use_sim_time: false"]
    for section in sections:
        lines += ["", *_comment([f"--- {section.heading}"], "    ")]
        for name, (spec, default) in specs(section.params).items():
            unit = f" {spec.unit}" if spec.unit else ""
            lines += _comment([f"{spec.doc} ({_ours(spec).wanted()}{',' + unit if unit else ''})"], "    ")
            # ROS has no list without entries: it stays unset.
            value = yaml_value(default) if default != () else "unset"
            mark = "" if section.declared and default != () else "# "
            lines.append(f"    {mark}{section.prefix}{name}: {value}")
    return "\n".join(lines) + "\n"


def _ours(spec: Spec) -> Spec:
    """Leave out of the choices what other packages on this machine bring."""
    return dataclasses.replace(spec, choices=spec.choices.own) if isinstance(spec.choices, Registry) else spec


def _comment(paragraphs: Iterable[str], indent: str) -> list[str]:
    lines = []
    for text in paragraphs:
        lines += textwrap.wrap(text, LINE_WIDTH, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ")
    return lines


def yaml_value(value: Any) -> str:
    """Write a value in YAML 1.1 so that every reader takes it for the same type: text is quoted, floats have a dot."""
    if isinstance(value, tuple):
        return "[" + ", ".join(map(yaml_value, value)) + "]"
    if isinstance(value, float):
        return re.sub(r"^(-?\d+)(e|$)", r"\1.0\2", repr(value)) if value - value == 0 else _not_finite(value)
    return json.dumps(value, ensure_ascii=False)


def _not_finite(value: float) -> str:
    return {"inf": ".inf", "-inf": "-.inf"}.get(repr(value), ".nan")


if __name__ == "__main__":
    docs()
