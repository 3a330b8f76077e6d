"""The data model: what a batch accepts, how it refuses, and how batches are cut, joined and read."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from track_fusion.linalg import is_positive_definite
from track_fusion.tracks import COASTED, CONFIRMED, SELF_REPORTED, StateLayout, TrackBatch, planar_layout

LAYOUT = planar_layout()
N = 4


def arrays(n: int = N, c: int = 1, **change: Any) -> dict[str, Any]:
    """Make the arguments of a good batch of n tracks of c components."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(n, c, 4, 6))
    weight = rng.uniform(0.5, 1.0, size=(n, c))
    fields = {
        "layout": LAYOUT, "frame_id": "map", "weight": weight / weight.sum(1, keepdims=True),
        "mean": rng.normal(size=(n, c, 4)), "cov": root @ np.swapaxes(root, -1, -2),
        "time_ns": np.full(n, 1_700_000_000_123_456_789), "track_id": np.arange(10, 10 + n),
        "source": np.full(n, 3), "status": np.full(n, CONFIRMED), "existence": np.full(n, 0.9),
        "dof": np.full(n, np.inf),
    }  # fmt: skip
    return fields | change


def changed(name: str, at: Any, value: Any, **kind: Any) -> dict[str, Any]:
    fields = arrays(**kind)
    fields[name] = np.array(fields[name])
    fields[name][at] = value
    return fields


def refusal(fields: dict[str, Any]) -> str:
    with pytest.raises(ValueError) as caught:
        TrackBatch(**fields)
    return str(caught.value)


def assert_equal(a: TrackBatch, b: TrackBatch) -> None:
    for field in dataclasses.fields(TrackBatch):
        np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name), field.name)


# Layouts ------------------------------------------------------------------------------------------------------------


def test_layout_knows_units_angles_and_groups() -> None:
    layout = StateLayout(("vx", "x", "yaw", "y", "turn_rate", "charge"))
    assert layout.size == 6
    assert layout.units == ("m/s", "m", "rad", "m", "rad/s", "")
    assert layout.angular.tolist() == [False, False, True, False, False, False]
    assert (layout.position, layout.velocity) == ((1, 3), (0,))
    assert layout.indices(["y", "x"]) == (3, 1)
    assert layout == StateLayout(layout.axes)


def test_layout_refuses_repeated_or_missing_axes() -> None:
    with pytest.raises(ValueError) as caught:
        StateLayout(("x", "x"))
    assert str(caught.value) == "The 'axes' of a layout must be distinct names. Got ('x', 'x')."
    with pytest.raises(ValueError):
        StateLayout(())
    with pytest.raises(ValueError) as caught:
        LAYOUT.indices(["x", "z", "vz"])
    assert str(caught.value) == "The layout has no axis z, vz. It has x, y, vx, vy."


# Construction -------------------------------------------------------------------------------------------------------


def test_a_good_batch_is_kept_as_given() -> None:
    fields = arrays(c=3)
    batch = TrackBatch(**fields)
    assert (len(batch), batch.components) == (N, 3)
    for name in ("weight", "mean", "time_ns", "track_id", "source", "status", "existence", "dof"):
        np.testing.assert_array_equal(getattr(batch, name), fields[name])
    assert batch.time_ns.dtype == batch.track_id.dtype == np.int64
    assert batch.time_ns[0] == 1_700_000_000_123_456_789  # to the nanosecond
    np.testing.assert_array_equal(batch.cov, np.swapaxes(batch.cov, -1, -2))


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        (arrays(mean=np.zeros((N, 4))), "The 'mean' of a batch must have shape (N, C >= 1, n). Got (4, 4)."),
        (arrays(mean=np.zeros((N, 0, 4))), "The 'mean' of a batch must have shape (N, C >= 1, n). Got (4, 0, 4)."),
        (arrays(mean=np.zeros((N, 1, 3))), "The 'mean' must have 4 axes, ('x', 'y', 'vx', 'vy'). Got 3."),
        (arrays(cov=np.eye(4)), "The 'cov' of a batch must have shape (4, 1, 4, 4). Got (4, 4)."),
        (arrays(weight=np.ones(N)), "The 'weight' of a batch must have shape (4, 1). Got (4,)."),
        (arrays(dof=np.inf), "The 'dof' of a batch must have shape (4,). Got ()."),
        (arrays(time_ns=np.zeros(3)), "The 'time_ns' of a batch must have shape (4,). Got (3,)."),
        (arrays(uuid=np.zeros((N, 4))), "The 'uuid' of a batch must have shape (4, 16). Got (4, 4)."),
    ],
)
def test_shapes_that_do_not_fit(fields: dict[str, Any], text: str) -> None:
    assert refusal(fields) == text
    with pytest.raises(ValueError):  # there is no telling which track is bad
        TrackBatch.screened(**fields)


#: Each fault: the fields of a batch in which track 12 (row 2) has it, the reason, and the words of the refusal.
FAULTS = [
    ("mean", (2, 0, 1), np.nan, "not_finite", "The 'mean' or 'cov' of a track must be finite: track 12 (1 in all)."),
    ("cov", (2, 0, 1, 1), np.inf, "not_finite", "The 'mean' or 'cov' of a track must be finite: track 12 (1 in all)."),
    ("mean", (2, 0, 1), 2e12, "absurd_value",
     "The 'mean' or 'cov' of a track must not exceed 1e+12 (cov: its square): track 12 (1 in all)."),
    ("cov", (2, 0, 1, 1), 2e24, "absurd_value",
     "The 'mean' or 'cov' of a track must not exceed 1e+12 (cov: its square): track 12 (1 in all)."),
    ("cov", (2, 0, 1, 0), 9.0, "asymmetric_covariance", "The 'cov' of a track must be symmetric: track 12 (1 in all)."),
    ("cov", 2, np.diag([1.0, 1.0, -2.0, 1.0]), "not_positive_definite",
     "The 'cov' of a track must be positive definite: track 12 (1 in all). Smallest eigenvalue: -2."),
    ("cov", 2, 0.0, "not_positive_definite",
     "The 'cov' of a track must be positive definite: track 12 (1 in all). Smallest eigenvalue: 0."),
    ("weight", (2, 0), 0.5, "bad_weight",
     "The 'weight' of a track must be non-negative and sum to 1: track 12 (1 in all). Got [0.5]."),
    ("weight", (2, 0), np.nan, "bad_weight",
     "The 'weight' of a track must be non-negative and sum to 1: track 12 (1 in all). Got [nan]."),
    ("existence", 2, 1.5, "bad_existence",
     "The 'existence' of a track must lie between 0 and 1: track 12 (1 in all). Got 1.5."),
    ("existence", 2, np.nan, "bad_existence",
     "The 'existence' of a track must lie between 0 and 1: track 12 (1 in all). Got nan."),
    ("dof", 2, 2.0, "bad_dof", "The 'dof' of a track must exceed 2: track 12 (1 in all). Got 2.0."),
    ("dof", 2, np.nan, "bad_dof", "The 'dof' of a track must exceed 2: track 12 (1 in all). Got nan."),
    ("track_id", 2, -1, "bad_track_id",
     "The 'track_id' of a track must fit 32 bits without sign: track -1 (1 in all). Got -1."),
    ("track_id", 2, 2**32, "bad_track_id",
     "The 'track_id' of a track must fit 32 bits without sign: track 4294967296 (1 in all). Got 4294967296."),
    ("track_id", 2, 10, "duplicate_track_id", "The 'track_id' of a track must be unique: track 10 (1 in all). Got 10."),
]  # fmt: skip
EVERY_FAULT = pytest.mark.parametrize(
    ("name", "at", "value", "reason", "text"), FAULTS, ids=[f"{f[3]}-{f[0]}-{i}" for i, f in enumerate(FAULTS)]
)


@EVERY_FAULT
def test_a_bad_track_is_refused_in_words(name: str, at: Any, value: Any, reason: str, text: str) -> None:
    assert refusal(changed(name, at, value)) == text


@EVERY_FAULT
def test_screening_drops_and_counts_the_bad_track_alone(name: str, at: Any, value: Any, reason: str, text: str) -> None:
    batch, rejected = TrackBatch.screened(**changed(name, at, value))
    assert rejected == {reason: 1}
    assert_equal(batch, TrackBatch(**arrays())[[0, 1, 3]])


def test_screening_counts_every_track_once_under_its_first_reason() -> None:
    fields = arrays(n=6)
    fields["mean"][0] = np.nan
    fields["existence"] = np.array([2.0, 2.0, 2.0, 0.5, 0.5, 0.5])
    fields["cov"][1] = -np.eye(4)
    fields["dof"] = np.array([np.inf, np.inf, 1.0, 1.0, 5.0, 5.0])
    batch, rejected = TrackBatch.screened(**fields)
    assert rejected == {"not_finite": 1, "not_positive_definite": 1, "bad_existence": 1, "bad_dof": 1}
    assert batch.track_id.tolist() == [14, 15]


def test_screening_may_leave_nothing_and_need_not_drop_anything() -> None:
    batch, rejected = TrackBatch.screened(**arrays(existence=np.full(N, 7.0)))
    assert (len(batch), rejected) == (0, {"bad_existence": N})
    batch, rejected = TrackBatch.screened(**arrays())
    assert_equal(batch, TrackBatch(**arrays()))
    assert not rejected


def test_a_missing_or_misspelt_array_is_named() -> None:
    fields = arrays()
    del fields["dof"]
    with pytest.raises(TypeError, match="The array 'dof' of a batch is missing."):
        TrackBatch.screened(**fields)
    with pytest.raises(TypeError, match="The array 'dofs' of a batch is unknown."):
        TrackBatch.screened(**arrays(), dofs=np.ones(N))


def test_rounding_noise_in_a_covariance_is_symmetrised() -> None:
    fields = arrays()
    wanted = fields["cov"].copy()
    fields["cov"] = fields["cov"] * (1.0 + 1e-8 * np.triu(np.ones((4, 4)), 1))
    batch = TrackBatch(**fields)
    np.testing.assert_array_equal(batch.cov, np.swapaxes(batch.cov, -1, -2))
    np.testing.assert_allclose(batch.cov, wanted, rtol=1e-7)


def test_particles_are_components_without_covariance_and_one_alone_is_an_error() -> None:
    particles = arrays(c=3, cov=np.zeros((N, 3, 4, 4)))
    assert TrackBatch(**particles).components == 3
    particles["weight"] = np.tile([1.0, 0.0, 0.0], (N, 1))
    assert refusal(particles).startswith("The 'cov' of a track must be positive definite: track 10 (4 in all).")
    mixed = arrays(c=2)
    mixed["cov"][1, 1] = 0.0  # one component with, one without
    assert TrackBatch.screened(**mixed)[1] == {"not_positive_definite": 1}


def test_unnormalised_weights_belong_to_phds() -> None:
    fields = arrays(c=2, weight=np.full((N, 2), 1.4))
    assert "sum to 1" in refusal(fields)
    assert TrackBatch(**fields, phd=True).weight.sum() == pytest.approx(2.8 * N)
    fields["weight"] = np.array([[1.0, -0.1]] * N)
    assert TrackBatch.screened(**fields, phd=True)[1] == {"bad_weight": N}


# Empty batches ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("components", [1, 5])
def test_empty_batches_work_everywhere(components: int) -> None:
    empty = TrackBatch(**arrays(n=0, c=components))
    assert len(empty) == 0
    assert TrackBatch.screened(**arrays(n=0, c=components))[1] == {}
    assert empty[np.zeros(0, bool)].components == components
    assert [m.shape for m in empty.moments] == [(0, 4), (0, 4, 4)]
    assert empty.is_confirmed.shape == empty.is_coasted.shape == (0,)
    assert empty.to_axes(StateLayout(("vx", "x"))).mean.shape == (0, components, 2)
    full = TrackBatch(**arrays(c=2))
    for joined in (TrackBatch.concatenate([empty, full]), TrackBatch.concatenate([full, empty])):
        assert joined.components == max(2, components)
        assert_equal(joined.replace(**{f: getattr(joined, f)[:, :2] for f in ("weight", "mean", "cov")}), full)
    assert len(TrackBatch.concatenate([TrackBatch.empty(LAYOUT, "map")] * 2)) == 0


# Selection and joining ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "index", [np.array([True, False, False, True]), np.array([3, 0]), slice(1, None, 2), [2]], ids=str
)
def test_selection_takes_the_same_rows_of_every_array(index: Any) -> None:
    fields = arrays(c=2, uuid=np.arange(16 * N).reshape(N, 16), track_id=np.array([7, 5, 3, 1]))
    batch = TrackBatch(**fields)
    part = batch[index]
    rows = np.arange(N)[index]
    assert len(part) == len(rows)
    for name, value in fields.items():
        if name not in ("layout", "frame_id", "cov"):
            np.testing.assert_array_equal(getattr(part, name), value[rows])
    np.testing.assert_array_equal(part.moments[0], batch.moments[0][rows])


def test_concatenation_pads_components_without_changing_any_track() -> None:
    one, three = TrackBatch(**arrays(c=1)), TrackBatch(**arrays(n=2, c=3, track_id=np.array([80, 81])))
    joined = TrackBatch.concatenate([one, three])
    assert joined.components == 3
    assert joined.track_id.tolist() == [10, 11, 12, 13, 80, 81]
    for i, wanted in enumerate((one.moments, three.moments)):
        rows = slice(0, 4) if i == 0 else slice(4, 6)
        for got, want in zip(joined[rows].moments, wanted, strict=True):
            np.testing.assert_allclose(got, want, rtol=1e-12)
    np.testing.assert_array_equal(joined.weight[:4, 1:], 0.0)
    assert is_positive_definite(joined.cov).all()
    again = {f.name: getattr(joined, f.name) for f in dataclasses.fields(TrackBatch)}
    assert_equal(TrackBatch(**again), joined)  # it passes every check


def test_concatenation_keeps_identities_and_blanks_the_missing() -> None:
    named = TrackBatch(**arrays(n=1, uuid=np.full((1, 16), 9)))
    joined = TrackBatch.concatenate([TrackBatch(**arrays(n=2)), named])
    assert joined.uuid is not None
    assert joined.uuid.tolist() == [[0] * 16, [0] * 16, [9] * 16]
    assert TrackBatch.concatenate([TrackBatch(**arrays())] * 2).uuid is None


def test_concatenation_refuses_what_does_not_belong_together() -> None:
    batch = TrackBatch(**arrays())
    with pytest.raises(ValueError) as caught:
        TrackBatch.concatenate([])
    assert str(caught.value) == "The 'batches' parameter must hold at least one batch. Got none."
    with pytest.raises(ValueError) as caught:
        TrackBatch.concatenate([batch, batch.replace(frame_id="odom")])
    assert str(caught.value) == (
        "Batches must share layout, frame and kind. "
        "Got ('x', 'y', 'vx', 'vy') in 'map' and ('x', 'y', 'vx', 'vy') in 'odom'."
    )
    for other in (batch.to_axes(StateLayout(("x", "y"))), batch.replace(phd=True)):
        with pytest.raises(ValueError, match="must share layout, frame and kind"):
            TrackBatch.concatenate([batch, other])


def test_other_axes_are_a_permutation_or_a_marginal() -> None:
    batch = TrackBatch(**arrays(c=2))
    turned = batch.to_axes(StateLayout(("vy", "x")))
    np.testing.assert_array_equal(turned.mean, np.stack([batch.mean[..., 3], batch.mean[..., 0]], -1))
    np.testing.assert_array_equal(turned.cov[..., 0, 0], batch.cov[..., 3, 3])
    np.testing.assert_array_equal(turned.cov[..., 0, 1], batch.cov[..., 3, 0])
    assert batch.to_axes(LAYOUT) is batch
    back = batch.to_axes(StateLayout(("vy", "vx", "y", "x"))).to_axes(LAYOUT)
    assert_equal(back, batch)
    with pytest.raises(ValueError, match="The layout has no axis z. It has x, y, vx, vy."):
        batch.to_axes(StateLayout(("x", "z")))


def test_moments_of_a_mixture_are_those_of_its_samples() -> None:
    """Two hundred thousand draws: each moment lies within four standard errors."""
    batch = TrackBatch(**arrays(n=1, c=3))
    rng = np.random.default_rng(2)
    draws = 200_000
    which = rng.choice(3, draws, p=batch.weight[0])
    roots = np.linalg.cholesky(batch.cov[0])
    samples = batch.mean[0, which] + np.einsum("sij,sj->si", roots[which], rng.normal(size=(draws, 4)))
    mean, cov = (m[0] for m in batch.moments)
    sigma = np.sqrt(np.diag(cov))
    assert (np.abs(samples.mean(0) - mean) < 4.0 * sigma / np.sqrt(draws)).all()
    np.testing.assert_allclose(np.cov(samples.T) / np.outer(sigma, sigma), cov / np.outer(sigma, sigma), atol=0.02)


def test_moments_of_one_component_are_the_component() -> None:
    batch = TrackBatch(**arrays())
    np.testing.assert_array_equal(batch.moments[0], batch.mean[:, 0])
    np.testing.assert_array_equal(batch.moments[1], batch.cov[:, 0])


def test_moments_follow_a_replacement() -> None:
    batch = TrackBatch(**arrays(c=2))
    before = batch.moments[0].copy()
    moved = batch.replace(mean=batch.mean + 5.0)
    np.testing.assert_allclose(moved.moments[0], before + 5.0)


def test_status_bits() -> None:
    status = np.array([0, CONFIRMED, COASTED, CONFIRMED | COASTED | SELF_REPORTED])
    batch = TrackBatch(**arrays(status=status))
    assert batch.is_confirmed.tolist() == [False, True, False, True]
    assert batch.is_coasted.tolist() == [False, False, True, True]


def test_gaussian_fills_in_the_rest() -> None:
    batch = TrackBatch.gaussian(LAYOUT, "map", np.zeros((3, 4)), np.tile(np.eye(4), (3, 1, 1)), time_ns=5)
    assert batch.track_id.tolist() == [0, 1, 2]
    assert batch.time_ns.tolist() == [5, 5, 5]
    assert batch.is_confirmed.all()
    assert np.isinf(batch.dof).all()
    assert (batch.weight == 1.0).all()


def test_a_batch_cannot_be_changed_by_assignment() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        TrackBatch(**arrays()).frame_id = "odom"  # type: ignore[misc]


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.lists(st.tuples(st.integers(0, 4), st.integers(1, 3)), min_size=1, max_size=4))
def test_cutting_what_was_joined_gives_the_pieces_back(sizes: list[tuple[int, int]]) -> None:
    pieces, start = [], 0
    for n, c in sizes:
        pieces.append(TrackBatch(**arrays(n=n, c=c, track_id=np.arange(start, start + n))))
        start += n
    joined = TrackBatch.concatenate(pieces)
    assert len(joined) == start
    first = 0
    for piece in pieces:
        part = joined[first : first + len(piece)]
        c = piece.components
        assert_equal(part.replace(weight=part.weight[:, :c], mean=part.mean[:, :c], cov=part.cov[:, :c]), piece)
        first += len(piece)


def test_bad_covariances_are_found_one_by_one() -> None:
    good = np.broadcast_to(np.eye(3), (257, 3, 3)).copy()
    bad = [0, 100, 101, 256]
    good[bad] *= -1.0
    assert np.flatnonzero(~is_positive_definite(good)).tolist() == bad
    assert is_positive_definite(good[1:13].reshape(3, 4, 3, 3)).all()
    assert is_positive_definite(np.zeros((0, 3, 3))).shape == (0,)
    assert not is_positive_definite(-np.eye(2))


# Values -------------------------------------------------------------------------------------------------------------


def test_what_is_owned_can_be_written_to_by_nobody() -> None:
    base = np.zeros((N, 4))
    fields = arrays(mean=base[:, None], uuid=np.zeros((N, 16), np.uint8))
    batch = TrackBatch(**fields)
    own = batch.owned()
    assert_equal(own, batch)
    base[:] = 7.0
    assert (batch.mean == 7.0).all()
    assert not own.mean.any()
    for field in dataclasses.fields(TrackBatch):
        if isinstance(array := getattr(own, field.name), np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                array[...] = 0
    again = own.owned()
    assert all(getattr(again, f.name) is getattr(own, f.name) for f in dataclasses.fields(TrackBatch))


def test_what_was_worked_out_is_kept_until_its_arrays_are_replaced() -> None:
    batch = TrackBatch(**arrays(c=2))
    conditioned, moments = batch.well_conditioned, batch.moments
    assert conditioned.all()
    later = batch.replace(time_ns=batch.time_ns + 1).owned()
    assert later.well_conditioned is conditioned
    moved = batch.replace(mean=batch.mean + 1.0)
    assert moved.well_conditioned is conditioned
    np.testing.assert_allclose(moved.moments[0], moments[0] + 1.0)
    singular = batch.replace(cov=np.ones_like(batch.cov))
    assert not singular.well_conditioned.any()
    np.testing.assert_array_equal(batch[[2, 0]].well_conditioned, conditioned[[2, 0]])
