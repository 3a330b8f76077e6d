"""The centre as a value: a step changes nothing, is the same however often it is made, and survives pickling."""

import dataclasses
import pickle

import numpy as np
import pytest

from track_fusion import tracks as tracks_module
from track_fusion.centre import pool as pool_module
from track_fusion.centre.associate import Association, associate
from track_fusion.centre.config import (
    MAX_SOURCES,
    CentreConfig,
    FusionCentreParams,
    IdentityParams,
    SourceConfig,
    TrackManagerParams,
)
from track_fusion.centre.fuse import fuse
from track_fusion.centre.links import Links
from track_fusion.centre.pool import Pool, admitted
from track_fusion.centre.state import CentreState
from track_fusion.centre.step import step
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.models.transforms import Transform
from track_fusion.params import ParameterError
from track_fusion.random_streams import StreamPosition, stream
from track_fusion.rules import RULES
from track_fusion.tracks import StateLayout, TrackBatch, planar_layout

SECOND = 10**9
LAYOUT = planar_layout()
MOTION = NearlyConstantVelocity(LAYOUT, MotionParams(process_noise=1.0))
DRAWING = [key for key, rule in RULES.items() if "seed" in rule.optional and not rule.needed(rule.params())]


def config(rule="covariance_intersection", sources=("a", "b"), **params):
    sources = tuple(s if isinstance(s, SourceConfig) else SourceConfig(s) for s in sources)
    manager = TrackManagerParams(confirmation_threshold=(1, 1), deletion_threshold=(2, 2))
    rule = RULES[rule]
    own, identity = FusionCentreParams(**params), IdentityParams("test")
    return CentreConfig(sources, MOTION, "map", rule, rule.params(), own, manager, identity=identity)


def scan(rng, time_ns, count=3, components=1):
    """Tracks of targets 100 m apart with errors and covariances of their own."""
    mean = np.zeros((count, components, 4))
    mean[..., 0] = 100.0 * np.arange(count)[:, None]
    mean += rng.normal(size=mean.shape)
    root = rng.normal(size=(count, components, 4, 6))
    weight = rng.uniform(0.5, 1.0, size=(count, components))
    return TrackBatch(
        LAYOUT, "map", weight / weight.sum(1, keepdims=True), mean, root @ np.swapaxes(root, -1, -2),
        np.full(count, time_ns), np.arange(count), np.zeros(count, np.uint32), np.ones(count, np.uint8), np.ones(count),
        np.full(count, np.inf),
    )  # fmt: skip


def scans(rng, steps, components=1):
    """New scans of two sources, step by step; the second misses every third, and one target dies at last."""
    for k in range(1, steps + 1):
        time_ns, count = k * SECOND // 10, 3 if k < 6 else 2
        new = {0: scan(rng, time_ns, count, components)}
        if k % 3:
            new[1] = scan(rng, time_ns, count)
        yield time_ns, new


def content(value):
    """All that a value holds, bit for bit, as something that can be compared."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if dataclasses.is_dataclass(value):
        return tuple(content(getattr(value, f.name)) for f in dataclasses.fields(value))
    return tuple(map(content, value)) if isinstance(value, tuple) else value


def arrays(value):
    if isinstance(value, np.ndarray):
        yield value
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from arrays(getattr(value, field.name))
    elif isinstance(value, tuple):
        for part in value:
            yield from arrays(part)


# ---- a value ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("components", [1, 3], ids=["gaussian", "mixture"])
@pytest.mark.parametrize("memory", [False, True], ids=["memoryless", "memory"])
@pytest.mark.parametrize("rule", ["naive", "covariance_intersection", "arithmetic_average", *DRAWING])
def test_the_same_state_stepped_twice_gives_the_same_bit_for_bit(rule, memory, components):
    """Also after it was stepped on, and from a pickle; no step changes what it is given."""
    own, kept = config(rule, memory=memory), []
    state = CentreState.initial(own)
    for time_ns, new in scans(np.random.default_rng(4), 3, components):
        kept.append((state, content(state), time_ns, new, content(tuple(new.values()))))
        state, *results = step(own, state, time_ns, new)
        kept[-1] += (content((state, *results)),)
    for before, told, time_ns, new, given, after in kept:
        assert content(before) == told
        assert content(tuple(new.values())) == given
        assert content(step(own, before, time_ns, new)) == after
        assert content(step(own, pickle.loads(pickle.dumps(before)), time_ns, new)) == after


def test_going_back_and_on_again_gives_the_same():
    own = config(max_scan_age_s=0.25)
    states, results = [CentreState.initial(own)], []
    given = list(scans(np.random.default_rng(5), 9))
    for time_ns, new in given:
        state, *result = step(own, states[-1], time_ns, new)
        states.append(state)
        results.append(content(tuple(result)))
    assert (len(states[5].central), len(states[-1].central)) == (3, 2)  # one died
    for back in (0, 4, 7):
        state = states[back]
        for k in range(back, len(given)):
            state, *result = step(own, state, *given[k])
            assert content(tuple(result)) == results[k]
        assert content(state) == content(states[-1])


@pytest.mark.parametrize("pickled", [False, True])
def test_its_arrays_refuse_writing(pickled):
    own = config()
    state = CentreState.initial(own)
    for time_ns, new in scans(np.random.default_rng(6), 2):
        state, published, _ = step(own, state, time_ns, new)
    state = pickle.loads(pickle.dumps(state)) if pickled else state
    held = [*arrays(state), *arrays(published)]
    assert len(held) > 30
    for array in held:
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
    with pytest.raises(dataclasses.FrozenInstanceError):
        state.time_ns = 3


def test_who_writes_to_the_arrays_of_a_scan_later_changes_nothing():
    own, given = config(max_scan_age_s=9.0), scan(np.random.default_rng(7), SECOND)
    state, *_ = step(own, CentreState.initial(own), SECOND, {0: given})
    expected = content(step(own, state, 2 * SECOND, {}))
    for array in arrays(given):
        if array.flags.writeable:
            array[...] = 0
    assert content(step(own, state, 2 * SECOND, {})) == expected


def test_a_stream_goes_on_from_its_position():
    rng = stream(3, 1, "centre")
    rng.random(5, dtype=np.float32)  # leaves half a draw
    place = StreamPosition.of(rng)
    twin = pickle.loads(pickle.dumps(place)).generator()
    for draw in (
        lambda g: g.random(3, dtype=np.float32),
        lambda g: g.standard_normal(4),
        lambda g: g.integers(9, size=5),
    ):
        np.testing.assert_array_equal(draw(rng), draw(twin))
    assert StreamPosition.of(twin) == StreamPosition.of(rng) != place


def test_only_a_rule_that_draws_has_a_stream():
    assert CentreState.initial(config("naive")).random is None
    assert CentreState.initial(config("geometric_mean_sampling")).random == StreamPosition.of(
        stream(0, 0, "fusion_centre")
    )


def test_time_does_not_go_back():
    own = config()
    state, *_ = step(own, CentreState.initial(own), SECOND, {})
    with pytest.raises(ValueError, match="The 'time_ns' of a step must not be before the last one, 1000000000. Got 5."):
        step(own, state, 5, {})


def test_more_sources_than_provenance_has_bits_are_refused():
    assert len(config(sources=map(str, range(MAX_SOURCES))).sources) == 32
    with pytest.raises(ParameterError, match="The 'sources' must be at most 32. Got 33."):
        config(sources=map(str, range(33)))


# ---- a source's own axes and frame ----------------------------------------------------------------------------------

#: Its axes in another order, one more, in a frame turned by a quarter and shifted.
OWN_LAYOUT = StateLayout(("vy", "yaw", "x", "vx", "y"))
OWN_MATRIX = np.array([
    [0, 0, 0, 0, -1],
    [0, 0, 1, 0, 0],
    [-1, 0, 0, 0, 0],
    [0, 0, 0, 1, 0],
], float)  # fmt: skip
TURNED = Transform(OWN_LAYOUT, "radar", OWN_MATRIX, np.array([7.0, -3.0, 0.0, 0.0]))


def seen_by_radar(batch):
    """The same tracks as the radar tells them, with a yaw that nothing else depends on."""
    back = np.linalg.pinv(OWN_MATRIX)
    yaw = np.diag([0.0, 0.1, 0.0, 0.0, 0.0])
    mean, cov = (batch.mean - TURNED.offset) @ back.T, back @ batch.cov @ back.T + yaw
    return TrackBatch.gaussian(OWN_LAYOUT, "radar", mean[:, 0], cov[:, 0], time_ns=batch.time_ns)


def test_tracks_of_other_axes_and_frame_are_fused_as_if_they_had_the_centres():
    rng = np.random.default_rng(8)
    plain, own = config(), config(sources=("a", SourceConfig("radar", transform=TURNED)))
    left, right = CentreState.initial(plain), CentreState.initial(own)
    for time_ns, new in scans(rng, 5):
        left, expected, _ = step(plain, left, time_ns, new)
        told = {k: seen_by_radar(batch) if k else batch for k, batch in new.items()}
        right, fused, _ = step(own, right, time_ns, told)
        assert fused.source.tolist() == expected.source.tolist()
        assert (fused.layout, fused.frame_id) == (LAYOUT, "map")
        np.testing.assert_allclose(fused.mean, expected.mean, rtol=1e-12, atol=1e-11)
        np.testing.assert_allclose(fused.cov, expected.cov, rtol=1e-9, atol=1e-12)


def test_the_identity_changes_no_bit():
    same = SourceConfig("b", transform=Transform(LAYOUT, "map", np.eye(4), np.zeros(4)))
    plain, own = config(), config(sources=("a", same))
    left, right = CentreState.initial(plain), CentreState.initial(own)
    for time_ns, new in scans(np.random.default_rng(9), 5):
        left, *expected = step(plain, left, time_ns, new)
        right, *got = step(own, right, time_ns, new)
        assert content(tuple(got)) == content(tuple(expected))


def test_a_scan_must_be_in_its_sources_own_axes():
    own = config(sources=(SourceConfig("radar", transform=TURNED),))
    with pytest.raises(ValueError, match="must hold vy, yaw, x, vx, y in 'radar', .* Got x, y, vx, vy in 'map'"):
        step(own, CentreState.initial(own), SECOND, {0: scan(np.random.default_rng(0), SECOND)})


@pytest.mark.parametrize("matrix", [np.eye(4)[:3], np.diag([1.0, 1.0, 1.0, 0.0]), np.eye(4)[[0, 1, 2, 2]]])
def test_a_transform_that_lacks_an_axis_is_refused(matrix):
    partial = SourceConfig("partial", transform=Transform(LAYOUT, "map", matrix, np.zeros(len(matrix))))
    with pytest.raises(ParameterError, match="'transform' of the source 'partial' must bring every axis .* rank 3"):
        config(sources=("a", partial))


def test_a_transforms_shapes_must_fit():
    with pytest.raises(ValueError, match=r"must have shapes \(n, 4\) and \(n,\). Got \(4, 3\) and \(4,\)"):
        Transform(LAYOUT, "map", np.ones((4, 3)), np.zeros(4))


def pooled(own, seed=10):
    rng, state = np.random.default_rng(seed), CentreState.initial(own)
    for time_ns, new in scans(rng, 2):
        state, *_ = step(own, state, time_ns, new)
    fresh, new = np.ones(len(own.sources), bool), {0: scan(rng, SECOND), 1: scan(rng, SECOND)}
    return Pool.of(own, admitted(own, state.newest, SECOND, new), state.central, fresh, SECOND), fresh


def test_the_mask_of_axes_is_all_true_and_goes_the_way_of_the_members():
    """All axes are there today; were one missing, a fused track would have those that some member has."""
    own = config()
    pool, fresh = pooled(own)
    assert pool.has.shape == (len(pool.tracks), 4)
    assert pool.has.all()
    has = np.random.default_rng(11).random(pool.has.shape) < 0.4
    pool = dataclasses.replace(pool, has=has)
    association = associate(own, pool, Links.none(), fresh)
    fused, _ = fuse(own, pool, association, None)
    assert len(fused.tracks) == 3
    assert not fused.has.all()
    for row, axes in enumerate(fused.has):
        members = association.member[association.target == row]
        assert len(members) == 2
        np.testing.assert_array_equal(axes, has[members].any(0))


def test_a_coasting_track_keeps_its_mask():
    own = config()
    pool, _ = pooled(own)
    has = np.random.default_rng(12).random(pool.has.shape) < 0.5
    pool = dataclasses.replace(pool, has=has)
    nobody = np.zeros(0, np.intp)
    fused, _ = fuse(own, pool, Association(nobody, nobody, 0, nobody, Links.none()), None)
    np.testing.assert_array_equal(fused.has, has[len(pool.source) :])


# ---- each property is checked once ----------------------------------------------------------------------------------


@pytest.fixture
def looked_at(monkeypatch):
    """How many covariances were looked at, by where."""
    counts = {"door and results": 0, "pool": 0}
    plain = tracks_module.is_well_conditioned

    def counting(where):
        def look(cov):
            counts[where] += cov[..., 0, 0].size
            return plain(cov)

        return look

    monkeypatch.setattr(tracks_module, "is_well_conditioned", counting("door and results"))
    monkeypatch.setattr(pool_module, "is_well_conditioned", counting("pool"))
    return counts


def test_a_track_is_looked_at_once_at_the_door_and_once_after_each_conversion(looked_at):
    own, rng = config(max_scan_age_s=9.0), np.random.default_rng(13)
    fields = [
        {f.name: getattr(b, f.name) for f in dataclasses.fields(b)} for b in (scan(rng, SECOND), scan(rng, SECOND))
    ]
    looked_at["door and results"] = 0
    new = {k: TrackBatch.screened(**given)[0] for k, given in enumerate(fields)}
    assert looked_at["door and results"] == 6
    state, *_ = step(own, CentreState.initial(own), SECOND, new)
    assert looked_at["door and results"] == 6 + 3  # three fused tracks
    step(own, state, 2 * SECOND, {})
    assert looked_at["door and results"] == 9 + 9 + 3  # all of them predicted, then fused
    turned = new[0].to_axes(StateLayout(("vx", "x"))).to_axes(StateLayout(("x", "vx")))
    assert turned.well_conditioned.all()
    assert looked_at["door and results"] == 21 + 3
    assert looked_at["pool"] == 0
