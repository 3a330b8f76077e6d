"""track-fusion scenarios: the published scenarios that can be repeated."""

from __future__ import annotations

import click


@click.command(short_help="List the published scenarios.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def scenarios(as_json: bool) -> None:
    """List the published scenarios: where each is from, what it shows, whether it runs over ROS.

    `track-fusion reproduce` runs them in the library, `track-fusion demo` over ROS.

    Example: track-fusion scenarios --json
    """
    from track_fusion.cli.output import console, print_json
    from track_fusion.scenarios import SCENARIOS

    names = ("key", "title", "paper", "shows", "default_runs", "published_runs", "assumptions")
    listed = [
        {**{name: getattr(s, name) for name in names}, "over_ros": s.tracking is not None} for s in SCENARIOS.values()
    ]
    if as_json:
        print_json(listed, indent=2)
        return
    from rich.markup import escape
    from rich.table import Table

    table = Table("scenario", "what it is and shows", "runs", "over ROS", show_lines=True)
    table.columns[0].no_wrap = True
    table.columns[2].justify = "right"
    for s in listed:
        about = f"[bold]{escape(s['title'])}[/bold]\n{escape(s['paper'])}\nShows {escape(s['shows'])}"
        table.add_row(s["key"], about, str(s["default_runs"]), "yes" if s["over_ros"] else "no")
    console().print(table)
