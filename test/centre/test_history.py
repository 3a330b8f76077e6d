"""Retrodiction: whatever the order of arrival, the centre ends where it would be had all come in time; names stay."""

import dataclasses
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from track_fusion.centre.config import (
    CentreConfig,
    FusionCentreParams,
    ScanBufferParams,
    SourceConfig,
    TrackManagerParams,
)
from track_fusion.centre.history import History, Late, forward, rewind
from track_fusion.centre.state import CentreState
from track_fusion.centre.step import step
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.params import ParameterError
from track_fusion.rules import RULES
from track_fusion.tracks import TrackBatch, planar_layout

MS, SECOND = 10**6, 10**9
LAYOUT = planar_layout()
MOTION = NearlyConstantVelocity(LAYOUT, MotionParams(process_noise=1.0))


def config(rule="covariance_intersection", sources=3, manager=None, params=None, **buffer):
    names = tuple(SourceConfig(f"source_{k}") for k in range(sources))
    manager = TrackManagerParams(**{"confirmation_threshold": (1, 1), "deletion_threshold": (2, 2)} | (manager or {}))
    params = FusionCentreParams(**{"memory": True} | (params or {}))
    buffer = ScanBufferParams(**{"out_of_sequence": "retrodict", "history_length_s": 100.0} | buffer)
    rule = RULES[rule]
    return CentreConfig(names, MOTION, "map", rule, rule.params(), params, manager, buffer)


def scan(time_ns, positions, ids=None, sd=1.0):
    """Tracks at rest at these x; identifiers count from 0 unless given."""
    mean = np.zeros((len(positions), 4))
    mean[:, 0] = positions
    cov = np.tile(np.diag([sd**2, sd**2, 0.5, 0.5]), (len(mean), 1, 1))
    return TrackBatch.gaussian(LAYOUT, "map", mean, cov, time_ns=time_ns, track_id=ids)


def scene(seed, sources=3, steps=12, spacing=100.0):
    """Scans by source and stamp: targets that live for a while, are missed at times, come near each other.

    A source has its own rate, so that some stamps are equal; its tracks have identifiers of their own.
    """
    rng, scans = np.random.default_rng(seed), []
    count = 4
    first, last = rng.integers(0, 5, count), rng.integers(6, steps + 4, count)
    start, speed = spacing * np.arange(count), rng.normal(0, 2.0, count)
    for source in range(sources):
        period = (1, 2, 3)[source]
        for k in range(1, steps + 1, period):
            seen = np.flatnonzero((first <= k) & (k < last) & (rng.random(count) > 0.1))
            rng.shuffle(seen)
            if rng.random() > 0.1:
                root = rng.normal(size=(len(seen), 4, 6))
                cov = root @ np.swapaxes(root, 1, 2) / 3
                mean = np.zeros((len(seen), 4))
                mean[:, 0], mean[:, 2] = start[seen] + speed[seen] * k / 10, speed[seen]
                mean += (np.linalg.cholesky(cov) @ rng.normal(size=(len(seen), 4, 1)))[..., 0]
                time_ns = k * SECOND // 10
                batch = TrackBatch.gaussian(
                    LAYOUT, "map", mean, cov, time_ns=time_ns, track_id=100 * source + seen
                )
                scans.append(Late(source, batch, time_ns))
    return scans


def in_order(own, scans):
    """The plain steps, one a stamp."""
    state = CentreState.initial(own)
    for time_ns in sorted({s.stamp_ns for s in scans}):
        state, *_ = step(own, state, time_ns, {s.source: s.scan for s in scans if s.stamp_ns == time_ns})
    return state


class Reader:
    """Feeds scans as they come, several at a time, and keeps what it got to read."""

    def __init__(self, own):
        self.config, self.history = own, History.of(CentreState.initial(own))
        self.read, self.kept_out, self.repeated, self.vanished = [], {}, 0, []

    def take(self, *scans):
        now_ns = self.history.present.state.time_ns
        late = [s for s in scans if s.stamp_ns <= now_ns]
        if late:
            self.history, rewound = rewind(self.config, self.history, late)
            self.repeated += rewound.repeated
            self.vanished += rewound.vanished.tolist()
            for reason, count in rewound.kept_out.items():
                self.kept_out[reason] = self.kept_out.get(reason, 0) + count
        for time_ns in sorted({s.stamp_ns for s in scans if s.stamp_ns > now_ns}):
            new = {s.source: s.scan for s in scans if s.stamp_ns == time_ns}
            self.history, published, info = forward(self.config, self.history, time_ns, new)
            self.read.append((time_ns, published, info))

    @property
    def state(self):
        return self.history.present.state

    @property
    def named(self):
        """Position of each living track by the name that readers know."""
        tracks = self.state.central.tracks
        return dict(zip(self.history.present.ids.tolist(), tracks.mean[:, 0, 0].tolist(), strict=True))


def content(value):
    """All that a value holds, bit for bit, as something that can be compared."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if dataclasses.is_dataclass(value):
        return tuple(content(getattr(value, f.name)) for f in dataclasses.fields(value))
    return tuple(map(content, value)) if isinstance(value, tuple) else value


# ---- the law ---------------------------------------------------------------------------------------------------------


@st.composite
def arrivals(draw):
    """Scans of a scene in any order, cut into the bunches in which they come."""
    scans = scene(draw(st.integers(0, 10**6)), spacing=draw(st.sampled_from([3.0, 100.0])))
    order = draw(st.permutations(range(len(scans))))
    cuts = sorted(draw(st.sets(st.integers(1, len(scans) - 1), max_size=len(scans))))
    bunches = [order[a:b] for a, b in zip([0, *cuts], [*cuts, len(scans)], strict=True)]
    return scans, [[scans[k] for k in bunch] for bunch in bunches]


RULES_TRIED = ["naive", "covariance_intersection", "arithmetic_average", "mhdp_iterative", "geometric_mean_sampling"]


@pytest.mark.parametrize("rule", [key for key in RULES_TRIED if key in RULES])
@settings(max_examples=15)
@given(arrivals())
def test_in_any_order_of_arrival_the_state_is_that_of_the_order_of_time_bit_for_bit(rule, drawn):
    """Its own numbering and the random stream included; only names depend on the order, and they stay distinct."""
    scans, bunches = drawn
    own = config(rule)
    reader = Reader(own)
    for bunch in bunches:
        reader.take(*bunch)
    assert reader.kept_out == {}
    assert content(reader.state) == content(in_order(own, scans))
    assert len(reader.named) == len(reader.state.central)
    times = [time_ns for time_ns, *_ in reader.read]
    assert times == sorted(set(times))
