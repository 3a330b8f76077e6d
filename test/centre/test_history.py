"""Retrodiction: whatever the order of arrival, the centre ends where it would be had all come in time; names stay."""

import dataclasses
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from track_fusion.centre.centre import FusionCentre
from track_fusion.centre.config import (
    CentreConfig,
    FusionCentreParams,
    IdentityParams,
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
    identity = IdentityParams("history")
    return CentreConfig(names, MOTION, "map", rule, rule.params(), params, manager, buffer, identity=identity)


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
                batch = TrackBatch.gaussian(LAYOUT, "map", mean, cov, time_ns=time_ns, track_id=100 * source + seen)
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


@settings(max_examples=10)
@given(arrivals())
def test_no_name_is_given_to_two_targets_far_apart(drawn):
    scans, bunches = drawn
    if any(len(s.scan) > 1 and np.diff(np.sort(s.scan.mean[:, 0, 0])).min() < 40 for s in scans):
        return  # targets 3 m apart: nobody can say whose track it is
    reader = Reader(config())
    lived = {}
    for bunch in bunches:
        reader.take(*bunch)
        for name, position in reader.named.items():
            lived.setdefault(name, set()).add(round(position / 100))
        for _, tracks, _ in reader.read:
            for name, position in zip(tracks.track_id.tolist(), tracks.mean[:, 0, 0].tolist(), strict=True):
                lived.setdefault(name, set()).add(round(position / 100))
    assert all(len(targets) == 1 for targets in lived.values())


@settings(max_examples=15)
@given(st.permutations(range(24)), st.integers(1, 4))
def test_published_names_stay_whatever_the_order(order, bunch):
    """Three targets that live throughout, two sources, the second at half the rate: each has one name for ever."""
    stamps = [(0, k) for k in range(16)] + [(1, 2 * k) for k in range(8)]
    rng = np.random.default_rng(3)
    scans = [
        Late(s, scan(t := (k + 1) * SECOND // 10, [0, 100, 200] + rng.normal(0, 0.1, 3), [7, 8, 9]), t)
        for s, k in stamps
    ]
    reader = Reader(config(sources=2))
    names = {}
    for k in range(0, len(order), bunch):
        reader.take(*(scans[i] for i in order[k : k + bunch]))
        for name, position in reader.named.items():
            names.setdefault(round(position / 100), set()).add(name)
    assert sorted(names) == [0, 1, 2]
    assert all(len(known) == 1 for known in names.values())
    assert set.union(*names.values()) == {1, 2, 3}  # and no number was wasted


# ---- names, case by case ---------------------------------------------------------------------------------------------


def at(tenths, *positions, source=0, ids=None):
    time_ns = tenths * SECOND // 10
    return Late(source, scan(time_ns, positions, ids), time_ns)


def test_a_track_that_turns_out_to_be_older_keeps_its_name():
    """By its own source, by another, or by both: the track takes up the source track that started it."""
    for late in ([at(8, 0.0)], [at(8, 0.2, source=1)], [at(7, 0.2, source=1), at(9, 0.1)]):
        reader = Reader(config())
        reader.take(at(5, 100.0, ids=[3]))
        reader.take(at(10, 0.0, 100.0, ids=[0, 3]))
        assert reader.named == {1: 100.0, 2: 0.0}
        reader.take(*late)
        assert sorted(reader.named) == [1, 2]
        assert abs(reader.named[2]) < 1.0
        reader.take(at(11, 300.0, ids=[5]))
        assert 3 in reader.named  # the next number


def test_of_two_published_tracks_that_become_one_the_older_name_lives():
    """A sharp scan shows that the target was half way: both scans are within the gate of it, not of each other."""
    reader = Reader(config(sources=2, params={"gate_probability": 0.9}))
    reader.take(at(10, 0.0, ids=[4]))
    reader.take(at(11, 5.2, source=1, ids=[9]))
    assert reader.named == {1: 0.0, 2: 5.2}
    reader.take(Late(1, scan(SECOND, [2.7], [9], sd=0.1), SECOND))
    assert sorted(reader.named) == [1]
    assert reader.vanished == [2]
    reader.take(at(12, reader.named[1], 500.0, source=1, ids=[9, 10]))
    assert sorted(reader.named) == [1, 3]  # the name that vanished is not given again


def test_a_name_that_vanished_comes_back_with_the_track():
    """Late misses of its only source kill a track; a late hit before them does not let it die."""
    reader = Reader(config(sources=2))
    reader.take(at(10, 0.0, ids=[4]))
    reader.take(at(14, 500.0, source=1, ids=[1]))
    assert sorted(reader.named) == [1, 2]
    reader.take(at(11), at(12))
    assert sorted(reader.named) == [2]
    assert reader.vanished == [1]
    reader.take(at(11, 0.1, source=1, ids=[2]))
    assert sorted(reader.named) == [1, 2]
    assert abs(reader.named[1]) < 1.0


def test_a_track_published_now_keeps_its_name_when_it_turns_out_that_an_older_one_never_died():
    """The one died and was published anew under another name: readers know that one now."""
    reader = Reader(config(sources=2))
    reader.take(at(10, 0.0, ids=[4]))
    for k in (11, 12):
        reader.take(at(k))  # two misses: dead
    assert reader.named == {}
    reader.take(at(13, 0.0, ids=[5]))
    assert sorted(reader.named) == [2]
    reader.take(at(11, 0.0, source=1, ids=[8]), at(12, 0.0, source=1, ids=[8]))
    assert sorted(reader.named) == [2]


# ---- where a scan belongs --------------------------------------------------------------------------------------------


def test_scans_that_wait_together_rewind_once():
    alone, together = Reader(config()), Reader(config())
    late = [at(k, 0.1 * k, source=1) for k in (3, 5, 8)]
    for reader in (alone, together):
        for k in range(1, 11):
            reader.take(at(k, 0.0))
    for one in late:
        alone.take(one)
    together.take(*late)
    assert (alone.repeated, together.repeated) == (8 + 6 + 3, 8)
    assert content(alone.state) == content(together.state)


def test_a_late_scan_of_the_stamp_of_a_step_joins_it_and_one_between_makes_its_own():
    reader = Reader(config())
    for k in (10, 20, 30):
        reader.take(at(k, 0.0))
    reader.take(at(20, 0.1, source=1))
    assert [kept.time_ns // (SECOND // 10) for kept in reader.history.kept] == [10, 20, 30]
    reader.take(at(25, 0.1, source=1))
    assert [kept.time_ns // (SECOND // 10) for kept in reader.history.kept] == [10, 20, 25, 30]
    assert [sorted(kept.scans) for kept in reader.history.kept] == [[0], [0, 1], [1], [0]]
    reader.take(at(5, 0.0, source=2))  # before all others
    assert len(reader.history.kept) == 5


def test_a_repeated_scan_is_kept_out_wherever_it_was_taken_and_an_empty_one_too():
    reader = Reader(config())
    for k in range(1, 5):
        reader.take(at(k, 0.0))
    reader.take(at(2), at(3, 5.0))
    assert reader.kept_out == {"duplicate_scan": 2}
    assert reader.repeated == 0
    own = config()
    history, *_ = forward(own, History.of(CentreState.initial(own)), SECOND, {0: scan(SECOND // 2, [0.0])})
    _, rewound = rewind(own, history, [Late(0, scan(SECOND // 2, [0.0]), SECOND // 2)])
    assert rewound.kept_out == {"duplicate_scan": 1}  # it was predicted to the step at one second


def test_pieces_of_one_scan_come_together_late():
    names = (SourceConfig("whole"), SourceConfig("pieces", assembles=True))
    own = dataclasses.replace(config(sources=2), sources=names)
    reader = Reader(own)
    pieces = [at(20, 0.0, source=1, ids=[0]), at(20, 100.0, source=1, ids=[1]), at(20, 100.0, source=1, ids=[1])]
    for k in (10, 20, 30):
        reader.take(at(k, 0.0, 100.0))
    for piece in pieces:
        reader.take(piece)
    assert reader.kept_out == {"duplicate_track_id": 1}
    whole = [at(k, 0.0, 100.0) for k in (10, 20, 30)] + [at(20, 0.0, 100.0, source=1)]
    assert content(reader.state) == content(in_order(own, whole))


def test_what_is_older_than_the_history_is_kept_out_and_told():
    reader = Reader(config(history_length_s=1.0))
    for k in range(1, 31):
        reader.take(at(k, 0.0))
    assert reader.history.begin_ns == 19 * SECOND // 10  # steps from 2.0 s on are kept
    before = reader.history
    reader.take(at(19, 0.0, source=1))
    assert reader.kept_out == {"older_than_history": 1}
    assert reader.history is before
    reader.take(at(20, 0.0, source=1))
    assert reader.kept_out == {"older_than_history": 1}
    assert reader.repeated == 11


def test_the_history_is_bounded_in_memory():
    wide, narrow = Reader(config()), Reader(config(history_megabytes=0.005))
    for reader in (wide, narrow):
        for k in range(1, 51):
            reader.take(at(k, 0.0, 100.0))
    held = [sum(kept.nbytes for kept in reader.history.kept) for reader in (wide, narrow)]
    assert held[0] > 20_000 > 5000 >= held[1] > 2500
    for kept in wide.history.kept:
        assert kept.nbytes <= len(pickle.dumps(kept))
    tiny = Reader(config(history_megabytes=1e-6))
    for k in range(1, 4):
        tiny.take(at(k, 0.0))
    tiny.take(at(2, 0.0, source=1))
    assert (tiny.history.kept, tiny.kept_out) == ((), {"older_than_history": 1})


def test_a_centre_that_does_not_retrodict_keeps_nothing():
    own = config(out_of_sequence="predict")
    history = History.of(CentreState.initial(own))
    for k in range(1, 4):
        history, published, _ = forward(own, history, k * SECOND, {0: scan(k * SECOND, [0.0])})
    assert history.kept == ()
    assert published.track_id.tolist() == history.present.ids.tolist() == [1]


def test_a_scan_that_is_not_late_is_refused():
    reader = Reader(config())
    reader.take(at(1, 0.0))
    with pytest.raises(ValueError, match=r"^A late scan must not be later than the last step, 100000000 ns. Got 2"):
        rewind(reader.config, reader.history, [at(2, 0.0)])


def test_retrodiction_without_memory_is_refused():
    with pytest.raises(ParameterError, match="^The 'out_of_sequence' parameter must be 'neglect' or 'predict' where"):
        config(params={"memory": False})


# ---- a value ---------------------------------------------------------------------------------------------------------


def test_a_rewind_changes_nothing_it_is_given_and_is_the_same_from_a_pickle():
    reader = Reader(config("geometric_mean_sampling"))
    scans = scene(5)
    for one in scans[::2]:
        reader.take(one)
    before, late = reader.history, [s for s in scans[1::2] if s.stamp_ns <= reader.state.time_ns]
    told = content(before.present), [content(kept.before) for kept in before.kept], before.kept
    after, rewound = rewind(reader.config, before, late)
    assert rewound.repeated > 0
    assert told == (content(before.present), [content(kept.before) for kept in before.kept], before.kept)
    again, _ = rewind(reader.config, pickle.loads(pickle.dumps(before)), late)
    assert content(again.present) == content(after.present)
    assert not after.present.ids.flags.writeable


# ---- as an object ----------------------------------------------------------------------------------------------------


def run(centre, arrivals):
    """Feed (now, source, scan) in the order of arrival; return what was published."""
    published = []
    for now_ns, late in arrivals:
        assert centre.receive(late.source, late.scan, late.stamp_ns, now_ns) is None
        published += centre.advance(now_ns)
    return published


def one_source_always_late(tenths, lag):
    """The first source at once, the second `lag` tenths of a second after its stamp."""
    arrivals = []
    for k in range(1, tenths + 1):
        arrivals.append((k * 100 * MS, at(k, 0.0, 100.0)))
        if k > lag:
            arrivals.append((k * 100 * MS + MS, at(k - lag, 0.1, 100.1, source=1)))
    return arrivals


@pytest.mark.parametrize("trigger", ["any_source", "all_sources", "rate"])
def test_a_source_that_is_always_late_counts_as_if_it_were_not(trigger):
    """Stamps strictly increase, names stay, and the end is that of the scans in their order."""
    buffer = {"trigger": trigger, "fusion_timeout_s": 0.0, "gather_window_s": 0.0, "output_rate_hz": 10.0}
    own = config(sources=2, **buffer)
    arrivals = one_source_always_late(30, 3)
    centre = FusionCentre(own, lambda: 0.0)
    published = run(centre, arrivals)
    times = [p.time_ns for p in published]
    assert times == sorted(set(times))
    assert {tuple(p.tracks.track_id.tolist()) for p in published[1:]} == {(1, 2)}
    assert sum(p.beyond_share for p in published) == 0
    assert all(not p.kept_out for p in published)
    assert sum(p.rewound is not None for p in published) >= 25
    waiting = [w.stamp_ns for w in centre.buffer.queues[1].waiting]
    taken = [late for _, late in arrivals if late.source == 0 or late.stamp_ns not in waiting]
    reference = CentreState.initial(own)
    for kept in centre.history.kept:
        new = {s.source: s.scan for s in taken if s.stamp_ns == kept.time_ns}
        assert sorted(new) == sorted(kept.scans)
        reference, *_ = step(own, reference, kept.time_ns, new)
    assert content(centre.state) == content(reference)


def test_late_scans_are_taken_up_when_no_other_scan_comes():
    centre = FusionCentre(config(sources=2, fusion_timeout_s=0.1), lambda: 0.0)
    run(centre, [(k * 100 * MS, at(k, 0.0)) for k in (1, 2, 3)])
    assert run(centre, [(301 * MS, at(2, 0.1, source=1))]) == []  # the stamp of the last step is not published twice
    (taken,) = centre.advance(420 * MS)
    assert taken.rewound.repeated == 2
    assert taken.time_ns == 300 * MS + 1
    assert taken.tracks.track_id.tolist() == [1]
