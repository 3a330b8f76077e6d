"""Identities: reproducible where a namespace is given, else never given again, and as lasting as the track."""

import uuid

import numpy as np
import pytest

from track_fusion.centre import identity as identity_module
from track_fusion.centre.centre import FusionCentre
from track_fusion.centre.config import CentreConfig, IdentityParams, SourceConfig, TrackManagerParams
from track_fusion.centre.identity import Identities
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.rules import RULES
from track_fusion.tracks import TrackBatch, planar_layout

LAYOUT, SECOND = planar_layout(), 10**9
START_NS = 1_764_302_403_123_456_789


def centre(namespace=""):
    rule, manager = RULES["naive"], TrackManagerParams(confirmation_threshold=(1, 1), deletion_threshold=(1, 1))
    motion, sources = NearlyConstantVelocity(LAYOUT, MotionParams()), (SourceConfig("a"), SourceConfig("b"))
    identity = IdentityParams(namespace)
    return FusionCentre(CentreConfig(sources, motion, "map", rule, rule.params(), manager=manager, identity=identity))


def scan(time_ns, *places):
    mean = np.array([[x, 0.0, 0.0, 0.0] for x in places]).reshape(-1, 4)
    return TrackBatch.gaussian(LAYOUT, "map", mean, np.tile(np.eye(4), (len(mean), 1, 1)), time_ns=time_ns)


def names(tracks):
    """UUIDs by number."""
    return {int(i): uuid.UUID(bytes=u.tobytes()) for i, u in zip(tracks.track_id, tracks.uuid, strict=True)}


def test_a_uuid_lasts_as_long_as_its_track():
    own, seen = centre(), []
    for k, places in enumerate([(0, 100), (0, 100), (0, 200), (0, 200)], 1):
        fused, _ = own.step(k * SECOND // 10, {0: scan(k * SECOND // 10, *places)})
        seen.append(names(fused))
    assert seen[0] == seen[1]
    assert seen[2] == seen[3]
    assert len(seen[0].keys() & seen[2].keys()) == 1
    assert all(seen[0][i] == seen[2][i] for i in seen[0].keys() & seen[2].keys())
    given = {**seen[0], **seen[2]}
    assert len(set(given.values())) == len(given) == 3
    assert {u.version for u in given.values()} == {5}


def test_a_namespace_makes_them_the_same_in_every_run_and_another_one_others():
    first, again, other = (centre(n).step(0, {0: scan(0, 0, 100)})[0] for n in ("run", "run", "others"))
    assert first.track_id.tolist() == again.track_id.tolist() == other.track_id.tolist() == [1, 2]
    assert names(first) == names(again)
    assert not set(names(first).values()) & set(names(other).values())
    # By the standard library, of names that anybody can write down.
    base = uuid.uuid5(uuid.uuid5(uuid.NAMESPACE_DNS, "track_fusion.identity_namespace"), "run")
    assert names(first) == {1: uuid.uuid5(base, "1"), 2: uuid.uuid5(base, "2")}


def test_restarts_give_no_identity_again(monkeypatch):
    """FIELD pain 34: one second apart, with hundreds of births in between, over a day of restarts."""
    numbers, uuids = [], []
    for start_s in (0, 1, 2, 3600, 86_400):
        monkeypatch.setattr(identity_module.time, "time_ns", lambda at=start_s: START_NS + at * SECOND)
        ids, names_, _ = Identities.begun(IdentityParams()).given(900)
        numbers += ids.tolist()
        uuids += [u.tobytes() for u in names_]
    assert len(set(numbers)) == len(numbers)
    assert len(set(uuids)) == len(uuids)
    assert max(numbers) < 2**31


def test_two_that_start_in_the_same_millisecond_have_other_uuids(monkeypatch):
    monkeypatch.setattr(identity_module.time, "time_ns", lambda: START_NS)
    left, right = centre(), centre()
    at = names(left.step(0, {0: scan(0, 0)})[0]), names(right.step(0, {0: scan(0, 0)})[0])
    assert at[0].keys() == at[1].keys() == {START_NS // 10**6 % 2**31}
    assert set(at[0].values()).isdisjoint(at[1].values())


@pytest.mark.parametrize("namespace", ["", "run"])
def test_a_reset_forgets_tracks_and_gives_no_identity_again(namespace):
    own = centre(namespace)
    before = names(own.step(SECOND, {0: scan(SECOND, 0, 100)})[0])
    own.reset()
    after = names(own.step(0, {0: scan(0, 0, 100)})[0])
    assert min(after) == max(before) + 1
    assert set(before.values()).isdisjoint(after.values())


def test_numbers_begin_again_at_0_after_the_last_that_the_wire_holds_and_uuids_do_not():
    late = Identities(uuid.UUID(int=7), 2**32 - 1)
    ids, uuids, after = late.given(3)
    assert ids.tolist() == [2**32 - 1, 0, 1]
    assert after.births == 2**32 + 2
    early = Identities(uuid.UUID(int=7), 0).given(2)[1]
    assert {u.tobytes() for u in uuids[1:]}.isdisjoint(u.tobytes() for u in early)


def test_nobody_newborn_costs_nothing_and_gives_nothing():
    ids, uuids, after = (begun := Identities(uuid.UUID(int=7), 5)).given(0)
    assert (ids.shape, uuids.shape, after) == ((0,), (0, 16), begun)
