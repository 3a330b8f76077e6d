"""track-fusion fuse: one fusion, JSON in, JSON out."""

from __future__ import annotations

import json
import sys

import click

from track_fusion.cli.output import print_json


@click.command(short_help="Fuse tracks given as JSON by a rule.")
@click.option("--rule", required=True, metavar="NAME", help="Fusion rule; `track-fusion rules` lists them.")
@click.option("--params", default="{}", metavar="JSON", help="The rule's parameters, an object; absent ones: default.")
def fuse(rule: str, params: str) -> None:
    """Fuse the tracks on standard input by a rule and print the fused track, both as JSON.

    \b
    Input: {"tracks": [TRACK, TRACK, ...]}, tracks of one target, at one time, in one frame.
    A TRACK is {"mean": [...], "cov": [[...]]}. It may hold
      "dof"         degrees of freedom of a Student-t track ("cov" is its covariance all the same)
      "components"  in place of mean and cov: [{"weight": w, "mean": [...], "cov": [[...]]}, ...]

    \b
    Beside "tracks" may stand
      "axes"        names of the axes: yaw, heading, course, roll, pitch, bearing, azimuth, elevation are angles in
                    radians and wrap, all others do not
      "angular"     names of further axes that are angles in radians; "yaw:pi": its sign is unknown, its period pi

    \b
    Where the rule needs it, and only there (see "needs" in `track-fusion rules`), in each TRACK
      "independent_cov"  the part of "cov" that is independent of the other tracks
      "likelihood"       of the track's measurements
    and beside "tracks"
      "common"     what the tracks have in common: {"mean", "cov"} or {"components"}
      "target"     the density to come near to: likewise
      "cross_cov"  of two tracks: the matrix cov(x0, x1); of K: K rows of K such blocks, null where i >= j
      "seed"       for a rule that samples (absent: 0)

    \b
    Output: {"mean", "cov", "dof", "weights", "info", "components"}; null is: Gaussian, no weights, no mixture.
    Wrong input ends with exit code 2 and one line that names the field.

    \b
    Example:
      echo '{"tracks": [{"mean": [0, 0], "cov": [[4, 0], [0, 1]]}, {"mean": [1, 0], "cov": [[1, 0], [0, 4]]}]}' |
        track-fusion fuse --rule covariance_intersection --params '{"criterion": "trace"}'
    """  # noqa: D301  click reads \b as "do not wrap"
    from track_fusion.cli.tracks_json import like_angles, read_tracks, write_fused
    from track_fusion.params import from_dict
    from track_fusion.rules import find_rule

    chosen = find_rule(rule)
    settings = from_dict(chosen.params, _read_params(params))
    if sys.stdin.isatty():
        click.echo("Reading tracks from the terminal; end with Ctrl-D.", err=True)
    tracks = read_tracks(sys.stdin.buffer.read(), chosen.needed(settings), chosen.key, chosen.optional)
    for axis in like_angles(tracks):
        advice = 'name the axes by "axes" if they are, so that they wrap.'
        click.echo(f"Note: the numbers of axis {axis} look like angles; {advice}", err=True)
    print_json(write_fused(chosen(tracks, settings)))


def _read_params(text: str) -> dict[str, object]:
    try:
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise click.UsageError(f"--params: is not JSON: {error}") from None
    if not isinstance(values, dict):
        raise click.UsageError(f"--params: must be a JSON object in braces; got {text}")
    return values
