"""track-fusion scenarios: the published scenarios that can be repeated."""

from __future__ import annotations

import click
from rich.markup import escape

from track_fusion.cli import output


@click.command(short_help="List the published scenarios.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def scenarios(as_json: bool) -> None:
    """List the published scenarios: where each is from, what it shows, whether it runs over ROS.

    `track-fusion reproduce` runs them in the library, `track-fusion demo` over ROS.

    Example: track-fusion scenarios --json
    """
    from track_fusion.demo.wiring import demos_of
    from track_fusion.scenarios import SCENARIOS

    names = ("key", "title", "paper", "shows", "default_runs", "published_runs", "assumptions")
    demos = {key: demos_of(key) for key in SCENARIOS}
    listed = [
        {**{name: getattr(s, name) for name in names}, "over_ros": bool(demos[s.key]), "demos": demos[s.key]}
        for s in SCENARIOS.values()
    ]
    if as_json:
        output.print_json(listed, indent=2)
        return
    out = output.console()
    for s in listed:
        out.print(f"[bold]{s['key']}[/bold]  {escape(s['title'])}")
        over_ros = ", ".join(f"track-fusion demo {name}" for name in s["demos"]) or "no"
        runs = f"{s['default_runs']} by default, {s['published_runs']} in the paper"
        out.print(output.grid([("Shows", s["shows"]), ("Paper", s["paper"]), ("Runs", runs), ("Over ROS", over_ros)]))
