"""What is declared of a source beside its tracks: how wrong its covariances are, and whose information they hold."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from track_fusion.angles import difference
from track_fusion.centre.config import CentreConfig
from track_fusion.linalg import Array
from track_fusion.tracks import TrackBatch

#: Provenance of tracks that may hold the information of any source.
_ANY_SOURCE = np.uint32(0xFFFFFFFF)


def as_declared(config: CentreConfig, source: int, scan: TrackBatch) -> TrackBatch:
    """Bring a scan, in the centre's axes, to what is declared of its source: `covariance_scale`, then `bias_sd`.

    A mixture is scaled about its mean, components and the spread of their means alike, and each component is widened by
    the bias. Particles are scaled likewise; with a bias they become one Gaussian, since a bias has a density and they
    have none.
    """
    settings = config.sources[source].settings
    if settings.covariance_scale != 1.0:
        scan = _scaled(scan, settings.covariance_scale)
    if settings.bias_sd:
        at = config.layout.position
        bias = np.zeros((config.layout.size, config.layout.size))
        bias[at, at] = settings.bias_sd**2 * config.brings[source, at]
        scan = _widened(scan, bias, config.floor)
    return scan if settings.is_self_reported else scan.replace(source=np.full(len(scan), _ANY_SOURCE))


def bare(tracks: TrackBatch) -> NDArray[np.bool_]:
    """Tell which tracks are particles, components without covariance, (N,)."""
    return np.asarray(~tracks.cov.any((1, 2, 3)))


def _scaled(scan: TrackBatch, factor: float) -> TrackBatch:
    cov = factor * scan.cov
    if scan.components == 1:
        return scan.replace(cov=cov)
    centre = scan.moments[0][:, None]
    apart = difference(scan.mean, centre, scan.layout.periods)
    return scan.replace(cov=cov, mean=centre + np.sqrt(factor) * apart)


def _widened(scan: TrackBatch, bias: Array, floor: Array) -> TrackBatch:
    """Add the covariance of a bias, (n, n); particles get that of a floor, too."""
    point = bare(scan)
    if not point.any():
        return scan.replace(cov=scan.cov + bias)
    mean, cov = scan.moments
    sole = np.arange(scan.components) == 0
    return scan.replace(
        weight=np.where(point[:, None], sole, scan.weight),
        mean=np.where(point[:, None, None], mean[:, None], scan.mean),
        cov=np.where(point[:, None, None, None], (cov + floor)[:, None], scan.cov) + bias,
    )
