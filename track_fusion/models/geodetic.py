"""Geodetic coordinates (WGS 84) to a local east-north-up frame; needs pymap3d."""

from __future__ import annotations

import dataclasses
from types import ModuleType

import numpy as np

from track_fusion.linalg import Array


def _pymap3d() -> ModuleType:
    try:
        import pymap3d
    except ImportError:
        raise ImportError(
            "Geodetic coordinates need pymap3d: pip install pymap3d, or track_fusion with its extra 'scenarios'."
        ) from None
    module: ModuleType = pymap3d
    return module


@dataclasses.dataclass(frozen=True)
class LocalFrame:
    """East-north-up axes tangent to the WGS 84 ellipsoid at an origin.

    Attributes
    ----------
    latitude_deg, longitude_deg    degrees
    altitude_m                     metres above the ellipsoid
    """

    latitude_deg: float
    longitude_deg: float
    altitude_m: float = 0.0

    def enu_from_geodetic(self, geodetic: Array) -> Array:
        """Turn latitude, longitude (degrees) and altitude (m), (..., 3), into east, north, up (m), (..., 3).

        Raises
        ------
        ImportError    pymap3d is missing
        """
        parts = (np.ascontiguousarray(geodetic[..., i]) for i in range(3))
        origin = self.latitude_deg, self.longitude_deg, self.altitude_m
        return np.stack(_pymap3d().geodetic2enu(*parts, *origin), -1).reshape(geodetic.shape)
