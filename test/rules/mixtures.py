"""What the tests of mixture rules share."""

from __future__ import annotations

from track_fusion.densities.mixture.mixture import Mixture, moments
from track_fusion.rules import SourceTracks


def as_tracks(mixture: Mixture) -> SourceTracks:
    """Tracks (..., K) of these mixtures (..., K, C)."""
    return SourceTracks(*moments(mixture), mixture=mixture)
