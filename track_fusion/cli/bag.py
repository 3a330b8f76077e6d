"""track-fusion bag: what can be done with a bag where there is no ROS."""

from __future__ import annotations

import click

from track_fusion.cli.bag_fuse import fuse


@click.group(short_help="Work on rosbag2 directories without ROS.")
def bag() -> None:
    """Work on rosbag2 directories, mcap or sqlite3; needs no ROS.

    Example: track-fusion bag fuse drive1 --params my_centre.yaml --out drive1_fused
    """


bag.add_command(fuse)
