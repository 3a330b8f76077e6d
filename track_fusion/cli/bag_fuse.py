"""track-fusion bag fuse: the fusion centre over a bag, without ROS."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from track_fusion.bags.fuse import Outcome


@click.command(short_help="Fuse the tracks of a bag as the fusion-centre node would.")
@click.argument("bag", type=click.Path(path_type=Path))
@click.option(
    "--params", required=True, type=click.Path(path_type=Path), help="Parameter file of the node fusion_centre."
)
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Directory of the new bag.")
@click.option("--storage", default="mcap", show_default=True, type=click.Choice(["mcap", "sqlite3"]))
@click.option(
    "--tail",
    default=0.5,
    show_default=True,
    type=click.FloatRange(min=0.0),
    help="Seconds for which the clock runs on after the last message, so that what waits is fused.",
)
def fuse(bag: Path, params: Path, out: Path, storage: str, tail: float) -> None:
    """Fuse the tracks in BAG, a rosbag2 directory, and write them on /fusion_centre/tracks into a new bag.

    The centre is that of the node, with the same parameter file; the time is that at which the bag's messages were
    received. The new bag holds all messages of the first one, too. Ctrl-C ends it earlier, and what is written by then
    is a whole bag. The sources' messages are track tables or Odometry (source_types); each source names its topic.

    \b
    Example, my_centre.yaml:
      fusion_centre:
        ros__parameters:
          source_configurations: [radar, camera]
          radar.topic: /radar/tracks
          camera.topic: /camera/tracks
          axes: ["x", "y", "vx", "vy"]
    \b
      track-fusion bag fuse drive1 --params my_centre.yaml --out drive1_fused
    """  # noqa: D301  click reads \b as "do not wrap"
    from track_fusion.bags.fuse import centre_of, fuse_bag
    from track_fusion.cli.app import INTERRUPTED
    from track_fusion.cli.progress import shown

    began = time.monotonic()
    centre = centre_of(params, lambda text: click.echo(text, err=True))
    with _told_to_stop() as stopped, shown(str(bag)) as progress:
        outcome = fuse_bag(bag, centre, out, storage, tail, progress, stopped)
    _report(outcome, out, time.monotonic() - began)
    if not outcome.ended:
        click.echo("Interrupted; what was fused by then is written.", err=True)
        click.get_current_context().exit(INTERRUPTED)


@contextmanager
def _told_to_stop() -> Iterator[Callable[[], bool]]:
    """Give a function that tells whether SIGINT or SIGTERM has come; neither breaks into a message half written."""
    came: list[int] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def note(number: int, frame: Any) -> None:
        came.append(number)

    try:
        for number in before:
            signal.signal(number, note)
        yield lambda: bool(came)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _report(outcome: Outcome, out: Path, took_s: float) -> None:
    click.echo(f"{outcome.messages} messages, {outcome.steps} fused tables in {took_s:.1f} s: {out}")
    for reason, count in sorted(outcome.rejected.items()):
        click.echo(f"{count:8d}  rejected: {reason}")
