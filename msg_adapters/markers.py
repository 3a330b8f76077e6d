"""visualization_msgs/MarkerArray: what RViz and Foxglove show of tracks. Build it only for subscribers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from msg_adapters.arrays import Floats, TrackLike, merged
from msg_adapters.header import NS_PER_S, make_header
from msg_adapters.orientation import from_matrix

_CONFIRMED, _COASTED = 1, 2
#: Red, green, blue, opacity.
_COLORS = {"confirmed": (0.1, 0.8, 0.2, 0.5), "tentative": (1.0, 0.7, 0.0, 0.5), "coasted": (0.6, 0.6, 0.6, 0.5)}
#: RViz complains of a scale of 0 (m); also the thickness of a flat ellipse.
_THIN_M = 0.01
_SHAFT_M, _HEAD_M, _TEXT_M = 0.1, 0.25, 0.5


def markers_to_msg(
    tracks: TrackLike,
    axes: Sequence[str],
    stamp_ns: int,
    *,
    sigmas: float = 2.0,
    horizon_s: float = 1.0,
    lifetime_s: float = 0.0,
    namespace: str = "",
) -> MarkerArray:
    """Draw each track: an ellipse (x, y) or ellipsoid (x, y, z), an arrow for its velocity, its id.

    The first marker deletes all earlier ones, so that an empty scan clears the view. Tracks with a
    value that is not finite are left out. Green is confirmed, amber tentative, grey coasted.

    Parameters
    ----------
    tracks : TrackLike      N tracks, mixtures are merged
    axes : sequence of str  must have x and y; the arrow needs vx and vy
    stamp_ns : int          header.stamp
    sigmas : float          half-axes of the ellipse in standard deviations
    horizon_s : float       the arrow's tip is where the track will be after this time, s
    lifetime_s : float      markers vanish after this time when no more come, s; 0 keeps them
    namespace : str         put before the namespaces `covariance`, `velocity`, `id`

    Raises
    ------
    ValueError    no x or no y among the axes
    """
    if "x" not in axes or "y" not in axes:
        raise ValueError(f"The axes must include x and y to be drawn. Got {tuple(axes)!r}.")
    header = make_header(stamp_ns, tracks.frame_id)
    out = [Marker(header=header, ns=namespace, action=Marker.DELETEALL)]
    mean, cov = merged(tracks, axes)
    drawn = np.flatnonzero(np.isfinite(mean).all(1) & np.isfinite(cov).all((1, 2)))
    position, spread = _picked(axes, ("x", "y", "z"), mean[drawn], cov[drawn])
    velocity, _ = _picked(axes, ("vx", "vy", "vz"), mean[drawn], cov[drawn])
    scale, orientation = _ellipsoids(spread, sigmas, flat="z" not in axes)
    moves = "vx" in axes and "vy" in axes
    life = Duration(sec=int(lifetime_s), nanosec=int(lifetime_s % 1 * NS_PER_S))
    for k, row in enumerate(drawn.tolist()):
        color = _color(int(tracks.status[row]))
        here = position[k].tolist()
        pen = _Pen(header, namespace, row, color, life)
        out.append(pen.ellipsoid(here, scale[k].tolist(), orientation[k], flat="z" not in axes))
        if moves:
            out.append(pen.arrow(here, (position[k] + horizon_s * velocity[k]).tolist()))
        out.append(pen.text(here, str(tracks.track_id[row])))
    return MarkerArray(markers=out)


class _Pen:
    """Makes the markers of one track, which share header, number, colour and lifetime."""

    def __init__(
        self, header: Header, prefix: str, number: int, color: tuple[float, float, float, float], life: Duration
    ) -> None:
        self._header, self._prefix, self._number, self._life = header, prefix, number, life
        self._color = color

    def _marker(self, kind: int, name: str, scale: list[float], pose: Pose, opaque: bool = True) -> Marker:
        r, g, b, a = self._color
        # Numbered by row, not by track id: ids have 32 bits, a marker's number 31; all are deleted each time.
        return Marker(
            header=self._header, ns=self._prefix + name, id=self._number, type=kind, action=Marker.ADD, pose=pose,
            scale=Vector3(x=scale[0], y=scale[1], z=scale[2]), lifetime=self._life,
            color=ColorRGBA(r=r, g=g, b=b, a=1.0 if opaque else a),
        )  # fmt: skip

    def ellipsoid(self, at: list[float], scale: list[float], turned: Quaternion, flat: bool) -> Marker:
        pose = Pose(position=_point(at), orientation=turned)
        return self._marker(Marker.CYLINDER if flat else Marker.SPHERE, "covariance", scale, pose, opaque=False)

    def arrow(self, start: list[float], tip: list[float]) -> Marker:
        marker = self._marker(Marker.ARROW, "velocity", [_SHAFT_M, _HEAD_M, 0.0], Pose())
        marker.points = [_point(start), _point(tip)]
        return marker

    def text(self, at: list[float], text: str) -> Marker:
        marker = self._marker(
            Marker.TEXT_VIEW_FACING, "id", [0.0, 0.0, _TEXT_M], Pose(position=_point([at[0], at[1], at[2] + _TEXT_M]))
        )
        marker.text = text
        return marker


def _point(at: list[float]) -> Point:
    return Point(x=at[0], y=at[1], z=at[2])


def _color(status: int) -> tuple[float, float, float, float]:
    if status & _COASTED:
        return _COLORS["coasted"]
    return _COLORS["confirmed" if status & _CONFIRMED else "tentative"]


def _picked(axes: Sequence[str], wanted: tuple[str, str, str], mean: Floats, cov: Floats) -> tuple[Floats, Floats]:
    """Pick three axes, mean (N, 3) and cov (N, 3, 3); an absent one is 0."""
    to = [k for k, a in enumerate(wanted) if a in axes]
    at = np.array([axes.index(wanted[k]) for k in to], int)
    out_mean, out_cov = np.zeros((len(mean), 3)), np.zeros((len(mean), 3, 3))
    out_mean[:, to] = mean[:, at]
    out_cov[np.ix_(range(len(mean)), to, to)] = cov[:, at[:, None], at]
    return out_mean, out_cov


def _ellipsoids(cov: Floats, sigmas: float, flat: bool) -> tuple[Floats, list[Quaternion]]:
    """Return full lengths of the axes (N, 3), m, and orientations of covariances (N, 3, 3)."""
    size = 2 if flat else 3
    values, vectors = np.linalg.eigh(cov[:, :size, :size])
    scale = np.full((len(cov), 3), _THIN_M)
    scale[:, :size] = np.maximum(2 * sigmas * np.sqrt(np.maximum(values, 0.0)), _THIN_M)
    turn = np.zeros((len(cov), 3, 3))
    turn[:, 2, 2] = 1.0
    turn[:, :size, :size] = vectors
    turn[:, :, 0] *= np.sign(np.linalg.det(turn))[:, None]  # eigenvectors may be a reflection
    return scale, [from_matrix(r) for r in turn.tolist()]
