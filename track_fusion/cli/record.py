"""track-fusion record: topics into a bag, where `ros2 bag record` is not to be had."""

from __future__ import annotations

from pathlib import Path

import click


@click.command(short_help="Record topics into a rosbag2 directory.")
@click.argument("out", type=click.Path(path_type=Path))
@click.argument("topics", nargs=-1, required=True)
@click.option("--storage", default="mcap", show_default=True, type=click.Choice(["mcap", "sqlite3"]))
@click.option("--sim-time", is_flag=True, help="Stamp messages with /clock instead of the wall clock.")
def record(out: Path, topics: tuple[str, ...], storage: str, sim_time: bool) -> None:
    """Record TOPICS into the new directory OUT until Ctrl-C.

    A topic is NAME, or NAME:TYPE when it has no publisher yet.

    \b
    Example:
      track-fusion record run1 /fusion_centre/tracks /fusion_centre/odometry:nav_msgs/msg/Odometry
    """  # noqa: D301  click reads \b as "do not wrap"
    from track_fusion.nodes.recorder import record_until_told

    for topic, count in record_until_told(out, topics, storage, sim_time).items():
        click.echo(f"{count:8d}  {topic}")
