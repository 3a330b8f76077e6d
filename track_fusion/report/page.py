"""One self-contained HTML page: measured beside published, claims, charts, assumptions; it loads nothing else."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from math import floor, isnan, log10
from typing import Any, NamedTuple

from track_fusion.report.drawing import svg
from track_fusion.study.chart import Chart
from track_fusion.study.scenario import Printed, Scenario

VERDICTS = ("agrees", "contradicts", "undecided", "by construction", "not given")
#: Units whose names in figures lack signs.
UNITS = {"mps": "m/s", "degps": "deg/s", "m2": "m²", "m4": "m⁴", "k": "K", "k2": "K²"}
#: Tables without published figures that are longer than this are folded.
FOLDED_ABOVE = 8
#: So many tables without published figures are shown; where there are more, all of them are folded.
BARE_SHOWN = 4
#: A claim that more figures decide shows them when asked.
EVIDENCE_SHOWN = 6

STYLE = """
:root { font: 16px/1.5 system-ui, sans-serif; color: #1c2733; background: #fff; }
body { max-width: 76rem; margin: 0 auto; padding: 0 1rem 4rem; overflow-wrap: break-word; }
h1 { font-size: 1.7rem; line-height: 1.2; }
h2 { margin: 3rem 0 .3rem; padding-top: 1rem; border-top: 2px solid #d4dbe2; line-height: 1.25; }
h3 { margin: 1.6rem 0 .4rem; }
p { max-width: 46rem; margin: .4rem 0; }
ul { max-width: 60rem; padding-left: 1.2rem; }
a { color: #14588f; }
summary { cursor: pointer; }
.quiet { color: #53616e; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: .4rem 0; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: 600; padding: .2rem 0; }
th, td { text-align: left; padding: .18rem .9rem .18rem 0; border-bottom: 1px solid #e4e9ee; vertical-align: top; }
.number { text-align: right; }
td.number { white-space: nowrap; }
.agrees { color: #0b6b34; }
.undecided { color: #80590a; }
.contradicts { color: #a61b1b; }
.by-construction, .not-given { color: #53616e; }
.tables { display: flex; flex-wrap: wrap; gap: 0 3rem; align-items: flex-start; }
.tables > * { max-width: 100%; }
.charts { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(22rem, 100%), 1fr)); gap: 1rem; }
.charts img { width: 100%; max-width: 36rem; height: auto; }
@media (max-width: 40rem) {
  .figures, .figures caption, .figures tbody { display: block; }
  .figures tr { display: grid; grid-template-columns: 7.5rem 5.5rem 1fr; border-bottom: 1px solid #e4e9ee; }
  .figures th, .figures td { border: 0; text-align: left; }
  .figures .name { grid-column: 1 / -1; }
}
"""


class Section(NamedTuple):
    """What the page says of one scenario.

    Attributes
    ----------
    result : mapping           scenario, runs, seed, figures, claims, as `track-fusion reproduce --json` prints them
    scenario : Scenario
    charts : sequence of Chart
    took_s : float             processor time in seconds
    """

    result: Mapping[str, Any]
    scenario: Scenario
    charts: Sequence[Chart]
    took_s: float


def page(sections: Sequence[Section], made_by: str) -> str:
    """Write the page; `made_by` (program, versions, time) is its last line."""
    title = sections[0].scenario.title if len(sections) == 1 else f"{len(sections)} published scenarios"
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,"><title>track_fusion: {escape(title)}</title><style>{STYLE}</style></head><body>
<h1>Measured beside published: {escape(title)}</h1>
<p>Each figure is measured by this program and set beside what its paper prints. {_explained()}</p>
{_overview(sections)}
{"".join(map(_section, sections))}
<p class="quiet">{escape(made_by)}</p>
</body></html>
"""


def _explained() -> str:
    meanings = {
        "agrees": "a figure within 3 standard deviations of the difference, the error of both studies and the rounding "
        "of the print together; a claim that holds beyond chance (99.9 %, the runs being paired)",
        "contradicts": "a figure further off; a claim that is false beyond chance",
        "undecided": "these runs cannot tell: a claim within chance or on fewer than ten runs, a figure of one run",
        "by construction": "it agrees, but no result could contradict it; not counted as agreement",
        "not given": "the paper prints nothing to compare with",
    }
    return " ".join(f"<b class='{_class(verdict)}'>{verdict}</b>: {text}." for verdict, text in meanings.items())


def _overview(sections: Sequence[Section]) -> str:
    rows = []
    for result, scenario, _, _ in sections:
        figures = Counter(f["verdict"] for f in result["figures"])
        claims = Counter(c["verdict"] for c in result["claims"])
        name = f"<a href='#{escape(scenario.key)}'>{escape(scenario.key)}</a>"
        cells = [
            f"<td class='number {_class(v)}'>{' + '.join((str(figures[v] or '–'), str(claims[v] or '–')))}</td>"
            if figures[v] or claims[v]
            else "<td></td>"
            for v in VERDICTS
        ]
        rows.append(f"<tr><td class='name'>{name}</td>{''.join(cells)}</tr>")
    heads = "".join(f"<th class='number'>{v}</th>" for v in VERDICTS)
    return (
        "<div class='scroll'><table><caption>Figures + claims by verdict</caption>"
        f"<tr><th>scenario</th>{heads}</tr>{''.join(rows)}</table></div>"
    )


def _section(section: Section) -> str:
    result, scenario, charts, took_s = section
    runs = f"{result['runs']} runs, seed {result['seed']}" if scenario.random else "nothing random"
    if scenario.random:
        runs += f"; for figures to be quoted: {scenario.publication_runs} runs; in the paper: {scenario.published_runs}"
    assumed = "".join(f"<li>{escape(assumption_text(a))}</li>" for a in scenario.assumptions)
    parts = [
        f"<h2 id='{escape(scenario.key)}'>{escape(scenario.key)}: {escape(scenario.title)}</h2>",
        f"<p>{escape(_sentence(scenario.shows))}</p><p class='quiet'>{escape(scenario.paper)}.</p>",
        f"<p class='quiet'>{runs}; {took_s:.1f} s of one processor.</p>",
        _tables(result["figures"]),
        _charts(charts),
        _claims(result["claims"]),
        "<h3>Assumed, where the paper is silent</h3>",
        f"<ul>{assumed}</ul>" if assumed else "<p>Nothing.</p>",
    ]
    return "".join(parts)


def assumption_text(text: str) -> str:
    """Write an assumption under a heading that says that it is one."""
    return text.removeprefix("assumed: ")


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}" + ("" if text.endswith(".") else ".")


def _claims(claims: Sequence[Mapping[str, Any]]) -> str:
    if not claims:
        return ""
    rows = [
        f"<tr><td>{escape(c['claim'])}<div class='quiet'>{escape(c['source'])}; {_evidence(c['evidence'])}</div></td>"
        f"{_verdict_cell(c)}</tr>"
        for c in claims
    ]
    head = "<tr><th>claim</th><th>verdict</th></tr>"
    return f"<h3>Claims</h3><div class='scroll'><table>{head}{''.join(rows)}</table></div>"


def evidence_text(evidence: Mapping[str, float]) -> str:
    """Write the figures that decide a claim, those of one quantity together."""
    groups: dict[str, list[str]] = {}
    for name, value in evidence.items():
        row, _, quantity = name.rpartition("/")
        groups.setdefault(quantity, []).append(f"{row} {value:.4g}")
    return "; ".join(f"{quantity_text(quantity)}: {', '.join(rows)}" for quantity, rows in groups.items())


def _evidence(evidence: Mapping[str, float]) -> str:
    """Fold the evidence where it is long."""
    text = _breakable(evidence_text(evidence))
    if len(evidence) <= EVIDENCE_SHOWN:
        return text
    return f"<details><summary>{len(evidence)} figures</summary>{text}</details>"


def _tables(figures: Sequence[Mapping[str, Any]]) -> str:
    """Write a table a quantity; long ones with nothing to compare are folded, and come last."""
    groups = by_quantity(figures)
    folded = unpublished(groups)
    tables = {q: _table(q, rows) for q, rows in groups.items()}
    shown = "".join(table for q, table in tables.items() if q not in folded)
    hidden = "".join(
        f"<details><summary>{escape(quantity_text(q))}: {len(groups[q])} rows, nothing published</summary>"
        f"{tables[q]}</details>"
        for q in tables
        if q in folded
    )
    return f"<h3>Figures</h3><div class='tables'>{shown}</div>{hidden}"


Groups = dict[str, list[Mapping[str, Any]]]


def by_quantity(figures: Sequence[Mapping[str, Any]]) -> Groups:
    """Group figures by their quantity, the end of their names."""
    groups: Groups = {}
    for figure in figures:
        groups.setdefault(figure["name"].rpartition("/")[2], []).append(figure)
    return groups


def unpublished(groups: Groups) -> set[str]:
    """Quantities of which nothing is published, where they or their rows are so many that they hide the rest."""
    bare = {q for q, rows in groups.items() if all(figure["published"] is None for figure in rows)}
    return {q for q in bare if len(groups[q]) > FOLDED_ABOVE or len(bare) > BARE_SHOWN}


def _table(quantity: str, rows: Sequence[Mapping[str, Any]]) -> str:
    title = quantity_text(quantity)
    body = "".join(
        f"<tr><td class='name'>{_breakable(f['name'].rpartition('/')[0])}</td>"
        f"<td class='number'>{measured_text(f['value'], f['standard_error'])}</td>"
        f"<td class='number'>{published_text(f['published'])}</td>"
        f"{_verdict_cell(f)}</tr>"
        for f in rows
    )
    return (
        f"<div class='scroll'><table class='figures'><caption>{escape(title)}</caption>"
        "<tr><th class='name'>row</th><th class='number'>measured</th>"
        f"<th class='number'>published</th><th>verdict</th></tr>{body}</table></div>"
    )


def quantity_text(quantity: str) -> str:
    """Write position_armse_m as "position armse / m"; a pure number has no unit."""
    name, _, unit = quantity.rpartition("_")
    return name.replace("_", " ") + ("" if unit == "1" else f" / {UNITS.get(unit, unit)}")


def published_text(value: float | None) -> str:
    """Write a published figure as it is printed."""
    if value is None:
        return ""
    return value.text if isinstance(value, Printed) else f"{value:g}"


def measured_text(value: float, error: float | None) -> str:
    """Write a figure with its standard error, where that is known (neither None nor NaN) and not zero."""
    return rounded(value, error) if error and not isnan(error) else f"{value:.5g}"


def rounded(value: float, error: float) -> str:
    """Write a value and its standard error to two digits of the error."""
    digits = max(0, 1 - floor(log10(error)))
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def _charts(charts: Sequence[Chart]) -> str:
    if not charts:
        return ""
    images = [
        f"<img alt='{escape(c.title, quote=True)}' src='data:image/svg+xml;base64,{_base64(svg(c))}'>" for c in charts
    ]
    return f"<h3>Pictures</h3><div class='charts'>{''.join(images)}</div>"


def _base64(text: str) -> str:
    return base64.b64encode(text.encode()).decode()


def _breakable(name: str) -> str:
    """Let a long name go on in the next line behind an underscore."""
    return escape(name).replace("_", "_<wbr>")


def verdict_text(judged: Mapping[str, Any]) -> str:
    """Write a verdict with its reason, where there is one."""
    return f"{judged['verdict']}: {judged['reason']}" if judged["reason"] else str(judged["verdict"])


def _verdict_cell(judged: Mapping[str, Any]) -> str:
    return f"<td class='{_class(judged['verdict'])}'>{escape(verdict_text(judged))}</td>"


def _class(verdict: str) -> str:
    return verdict.replace(" ", "-")
