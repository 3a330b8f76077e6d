"""Birth, confirmation, coasting, deletion and identity, counted per update of a source."""

import numpy as np
import pytest

from track_fusion.centre.config import CentreConfig, IdentityParams, SourceConfig, TrackManagerParams
from track_fusion.centre.fuse import Fused
from track_fusion.centre.identity import Identities
from track_fusion.centre.manage import manage
from track_fusion.centre.state import CentralTracks
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.params import ParameterError
from track_fusion.rules import RULES
from track_fusion.tracks import COASTED, CONFIRMED, TrackBatch, planar_layout

SECOND = 10**9
LAYOUT = planar_layout()


class Life:
    """Manages by hand: one call a step, naming which sources delivered and which tracks each supports."""

    def __init__(self, sources=2, **params):
        names = tuple(SourceConfig(str(k)) for k in range(sources))
        motion, rule = NearlyConstantVelocity(LAYOUT, MotionParams()), RULES["naive"]
        config = CentreConfig(names, motion, "map", rule, rule.params())
        self.central = CentralTracks.none(config, Identities.begun(IdentityParams("test")))
        self.params, self.sources, self.time = TrackManagerParams(**params), sources, 0
        self.stamps = ((),) * sources

    def step(self, fresh, members, births=0, dt_s=0.1):
        """`members`: for each living track, then each newborn, the set of sources with a member in it."""
        self.time += round(dt_s * SECOND)
        count = len(self.central) + births
        assert len(members) == count
        fused = TrackBatch.gaussian(
            LAYOUT, "map", np.zeros((count, 4)), np.tile(np.eye(4), (count, 1, 1)), time_ns=self.time
        )
        member = np.array([[k in m for k in range(self.sources)] for m in members], bool).reshape(count, self.sources)
        supported = np.array([self.time if m else -1 for m in members], np.int64)
        fresh = np.isin(np.arange(self.sources), list(fresh))
        fused = Fused(fused, np.ones((count, 4), bool))
        self.central, changes = manage(self.params, self.central, fused, member, fresh, supported, self.stamps)
        return changes

    @property
    def status(self):
        return dict(zip(self.central.tracks.track_id.tolist(), self.central.tracks.status.tolist(), strict=True))


def test_two_of_three_confirm_for_good():
    life = Life(confirmation_threshold=(2, 3), deletion_threshold=(9, 9))
    assert life.step({0}, [{0}], births=1).born.tolist() == [1]
    assert life.status == {1: 0}
    life.step({0}, [set()])
    assert life.status == {1: COASTED}
    assert life.step({0}, [{0}]).confirmed.tolist() == [1]
    assert life.status == {1: CONFIRMED}
    for _ in range(5):
        assert life.step({0}, [set()]).confirmed.tolist() == []
    assert life.status == {1: CONFIRMED | COASTED}


def test_hits_farther_apart_than_the_window_do_not_confirm():
    life = Life(confirmation_threshold=(2, 3), deletion_threshold=(9, 9))
    life.step({0}, [{0}], births=1)
    for hits in (set(), set(), {0}, set(), set(), {0}):
        life.step({0}, [hits])
        assert life.status[1] & CONFIRMED == 0


def test_a_centre_faster_than_its_source_counts_updates_of_the_source_only():
    """FIELD pain 1: ten steps between two scans neither confirm nor delete."""
    life = Life(confirmation_threshold=(2, 2), deletion_threshold=(2, 2))
    life.step({0}, [{0}], births=1)
    for _ in range(10):
        life.step(set(), [{0}])
    assert life.status == {1: 0}
    for _ in range(10):
        life.step(set(), [set()])
    assert life.status == {1: COASTED}
    life.step({0}, [{0}])
    assert life.status == {1: CONFIRMED}


def test_hits_of_different_sources_do_not_add_up():
    life = Life(confirmation_threshold=(2, 3))
    life.step({0, 1}, [{0, 1}], births=1)
    assert life.status == {1: 0}
    life.step({1}, [{1}])
    assert life.status == {1: CONFIRMED}


def test_a_fast_source_does_not_wear_out_what_only_a_slow_one_sees():
    life = Life(deletion_threshold=(3, 3), max_coast_s=100.0)
    life.step({0, 1}, [{0}], births=1)
    for _ in range(20):
        life.step({1}, [set()])
    assert 1 in life.status
    life.step({0}, [set()])
    life.step({0}, [set()])
    assert 1 in life.status
    assert life.step({0}, [set()]).deleted.tolist() == [1]


def test_deletion_needs_every_source_that_ever_hit_it():
    life = Life(deletion_threshold=(2, 3), max_coast_s=100.0)
    life.step({0, 1}, [{0, 1}], births=1)
    for _ in range(9):
        life.step({0}, [set()])
    life.step({0, 1}, [set()])
    assert 1 in life.status
    assert life.step({1}, [set()]).deleted.tolist() == [1]


@pytest.mark.parametrize(("missed", "last"), [(1, 1), (2, 2), (2, 4), (5, 5), (32, 32)])
def test_deletion_at_the_very_miss(missed, last):
    life = Life(sources=1, deletion_threshold=(missed, last), max_coast_s=100.0)
    for _ in range(40):
        life.step({0}, [{0}], births=len(life.status) == 0)
    for _ in range(missed - 1):
        assert life.step({0}, [set()]).deleted.tolist() == []
    assert life.step({0}, [set()]).deleted.tolist() == [1]


def test_misses_older_than_the_window_are_forgotten():
    life = Life(sources=1, deletion_threshold=(2, 3), max_coast_s=100.0)
    life.step({0}, [{0}], births=1)
    for hit in (False, True, True, False, True, True, False):
        life.step({0}, [{0} if hit else set()])
    assert 1 in life.status
    life.step({0}, [{0}])
    assert life.step({0}, [set()]).deleted.tolist() == [1]


def test_a_track_with_a_member_is_not_deleted_whatever_its_past():
    life = Life(deletion_threshold=(3, 5), max_coast_s=100.0)
    life.step({0}, [{0}], births=1)
    life.step({0}, [set()])
    life.step({0}, [set()])
    life.step({0}, [{0}])
    # The third miss of source 0, but an older scan of source 1 supports the track.
    assert life.step({0}, [{1}]).deleted.tolist() == []
    assert life.step({0}, [set()]).deleted.tolist() == [1]


def test_unsupported_for_too_long_is_deleted_without_any_scan():
    life = Life(deletion_threshold=(9, 9), max_coast_s=1.0)
    life.step({0}, [{0}], births=1)
    life.step(set(), [set()], dt_s=1.0)
    assert 1 in life.status
    assert life.step(set(), [set()], dt_s=1e-9).deleted.tolist() == [1]


def test_identifiers_count_up_and_are_never_used_again():
    life = Life(deletion_threshold=(1, 1))
    assert life.step({0}, [{0}, {0}], births=2).born.tolist() == [1, 2]
    assert life.step({0}, [set(), {0}]).deleted.tolist() == [1]
    assert life.step({0}, [set()]).deleted.tolist() == [2]
    assert life.step({0}, [{0}, {0}], births=2).born.tolist() == [3, 4]
    assert life.central.tracks.track_id.tolist() == [3, 4]


def test_a_deletion_leaves_the_others_their_history():
    life = Life(confirmation_threshold=(3, 3), deletion_threshold=(1, 1))
    life.step({0}, [{0}, {0}], births=2)
    life.step({0}, [{0}, {0}])
    assert life.step({0}, [set(), {0}]).confirmed.tolist() == [2]
    assert life.status == {2: CONFIRMED}


def test_a_track_deleted_on_the_step_is_not_reported_as_confirmed():
    life = Life(confirmation_threshold=(1, 1), deletion_threshold=(1, 1))
    changes = life.step({0}, [{0}], births=1)
    assert (changes.confirmed.tolist(), changes.deleted.tolist()) == ([1], [])
    changes = life.step({0}, [set()])
    assert (changes.confirmed.tolist(), changes.deleted.tolist()) == ([], [1])


@pytest.mark.parametrize("name", ["confirmation_threshold", "deletion_threshold"])
@pytest.mark.parametrize("value", [(3, 2), (1,), (1, 2, 3), (0, 1), (2, 33)])
def test_thresholds_that_make_no_sense_are_refused(name, value):
    with pytest.raises(ParameterError, match=f"The '{name}' parameter must be"):
        TrackManagerParams(**{name: value})
