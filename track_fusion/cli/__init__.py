"""The command line: track-fusion. One module a command; nothing here needs more than the standard library."""

from __future__ import annotations

import sys

#: Which optional extra of this package brings a missing module.
_EXTRAS = {
    **dict.fromkeys(("click", "jsonschema", "rich"), "cli"), "rosbags": "bags", "yaml": "bags",
    "matplotlib": "report", "rclpy": "ros",
}  # fmt: skip


def main() -> None:
    """Run the command line; a missing optional package ends in one line that says what to install."""
    try:
        from track_fusion.cli.app import cli

        cli(prog_name="track-fusion")
    except ImportError as error:
        module = (error.name or "").split(".")[0]
        if module not in _EXTRAS:
            raise
        advice = "source ROS 2 Jazzy, or " if module == "rclpy" else ""
        advice += f"pip install '.[{_EXTRAS[module]}]' in the source tree"
        print(f"track-fusion: the Python package {module} is missing: {advice}", file=sys.stderr)
        sys.exit(1)
