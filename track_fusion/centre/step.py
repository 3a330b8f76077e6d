"""One step of a fusion centre, a pure function of its state; doc/fusion-centre.md states each stage."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from track_fusion.centre.associate import associate
from track_fusion.centre.config import CentreConfig
from track_fusion.centre.duplicates import merge
from track_fusion.centre.fuse import fuse
from track_fusion.centre.manage import manage
from track_fusion.centre.pool import Pool, admitted
from track_fusion.centre.publish import StepInfo, publish, told
from track_fusion.centre.rhythm import Stamps, noted
from track_fusion.centre.state import CentreState
from track_fusion.tracks import TrackBatch


def step(
    config: CentreConfig, state: CentreState, time_ns: int, scans: Mapping[int, TrackBatch]
) -> tuple[CentreState, TrackBatch, StepInfo]:
    """Fuse at one time; equal arguments give equal results, bit for bit.

    Parameters
    ----------
    config : CentreConfig
    state : CentreState                the one before; it stays as it is
    time_ns : int                      fusion time, not before that of the last step
    scans : {source: TrackBatch}       new scans, stamped at or before `time_ns`, in their source's axes and frame

    Returns
    -------
    CentreState
    TrackBatch     the tracks to publish, all at `time_ns`
    StepInfo

    Raises
    ------
    ValueError    a scan does not fit, or time goes back
    """
    if time_ns < state.time_ns:
        raise ValueError(f"The 'time_ns' of a step must not be before the last one, {state.time_ns}. Got {time_ns}.")
    sources, before = len(config.sources), state.central
    newest = admitted(config, state.newest, time_ns, scans)
    fresh = np.zeros(sources, bool)
    fresh[list(scans)] = True
    pool = Pool.of(config, newest, before, fresh, time_ns)
    association = associate(config, pool, before.links, fresh)
    fused, random = fuse(config, pool, association, state.random)
    member = np.zeros((len(fused.tracks), sources), bool)
    member[association.target, pool.source[association.member]] = True
    supported_ns = np.full(len(fused.tracks), -1, np.int64)
    np.maximum.at(supported_ns, association.target, pool.stamp_ns[association.member])
    stamps = _noted(state.stamps, time_ns, scans)
    linked = dataclasses.replace(before, links=association.links)
    central, changes = manage(config.manager, linked, fused, member, fresh, supported_ns, stamps)
    central, merged = merge(config, central)
    info = told(pool, association, fused, before, changes, merged)
    return CentreState(central, newest, stamps, random, time_ns), publish(config.params, central.tracks), info


def _noted(stamps: tuple[Stamps, ...], time_ns: int, scans: Mapping[int, TrackBatch]) -> tuple[Stamps, ...]:
    """Note when new scans were made; one without tracks, whose stamp nobody told, at the time of the step."""
    told_ns = {k: int(scan.time_ns[0]) if len(scan) else time_ns for k, scan in scans.items()}
    return tuple(noted(own, told_ns[k]) if k in told_ns else own for k, own in enumerate(stamps))
