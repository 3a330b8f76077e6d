"""visualization_msgs/MarkerArray: what RViz and Foxglove show of tracks. Build it only for subscribers."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from msg_adapters.arrays import Floats, MergedLike
from msg_adapters.header import NS_PER_S, make_header
from msg_adapters.orientation import from_matrix

_CONFIRMED, _COASTED = 1, 2
#: Red, green, blue, opacity.
_COLORS = {"confirmed": (0.1, 0.8, 0.2, 0.5), "tentative": (1.0, 0.7, 0.0, 0.5), "coasted": (0.6, 0.6, 0.6, 0.5)}
#: RViz complains of a scale of 0 (m); also the thickness of a flat ellipse.
_THIN_M = 0.01
_SHAFT_M, _HEAD_M, _TEXT_M = 0.1, 0.25, 0.5


def markers_to_msg(
    tracks: MergedLike,
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
    value that is not finite are left out. Green is confirmed, amber tentative, grey coasted. A track's markers bear its
    number, less 2^32 from 2^31 on.

    Parameters
    ----------
    tracks : MergedLike     N tracks, mixtures are merged
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
    mean, cov = tracks.moments
    drawn = np.flatnonzero(np.isfinite(mean).all(1) & np.isfinite(cov).all((1, 2)))
    position, spread = _picked(axes, ("x", "y", "z"), mean[drawn], cov[drawn])
    velocity, _ = _picked(axes, ("vx", "vy", "vz"), mean[drawn], cov[drawn])
    scale, orientation = _ellipsoids(spread, sigmas, flat="z" not in axes)
    moves = "vx" in axes and "vy" in axes
    life = Duration(sec=int(lifetime_s), nanosec=int(lifetime_s % 1 * NS_PER_S))
    shape = Marker.SPHERE if "z" in axes else Marker.CYLINDER
    # A marker's number has a sign and a track's has none: the same 32 bits, so that no two tracks share one.
    numbers = tracks.track_id.astype(np.uint32).view(np.int32).tolist()
    for k, row in enumerate(drawn.tolist()):
        mark = partial(Marker, header=header, id=numbers[row], action=Marker.ADD, lifetime=life)
        r, g, b, a = _color(int(tracks.status[row]))
        here, color = position[k].tolist(), ColorRGBA(r=r, g=g, b=b, a=1.0)
        ellipsoid = Pose(position=_point(here), orientation=orientation[k])
        out.append(
            mark(ns=f"{namespace}covariance", type=shape, pose=ellipsoid, scale=_vector(scale[k].tolist()),
                 color=ColorRGBA(r=r, g=g, b=b, a=a))
        )  # fmt: skip
        if moves:
            arrow = [_point(here), _point((position[k] + horizon_s * velocity[k]).tolist())]
            size = _vector([_SHAFT_M, _HEAD_M, 0.0])
            out.append(mark(ns=f"{namespace}velocity", type=Marker.ARROW, points=arrow, scale=size, color=color))
        above, size = Pose(position=_point([*here[:2], here[2] + _TEXT_M])), _vector([0.0, 0.0, _TEXT_M])
        name = str(tracks.track_id[row])
        out.append(
            mark(ns=f"{namespace}id", type=Marker.TEXT_VIEW_FACING, pose=above, scale=size, color=color, text=name)
        )
    return MarkerArray(markers=out)


def _point(at: list[float]) -> Point:
    return Point(x=at[0], y=at[1], z=at[2])


def _vector(size: list[float]) -> Vector3:
    return Vector3(x=size[0], y=size[1], z=size[2])


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
