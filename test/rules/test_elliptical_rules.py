"""The rules for elliptical tracks: the static example of Chen 2022, searches by scipy, and limits."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from densities.elliptical import distances
from rules.examples import covariances
from scipy.optimize import brentq, minimize

from track_fusion.densities.elliptical.elliptical import Family, generalized_gaussian, student_t
from track_fusion.densities.elliptical.projection import nearest_mean
from track_fusion.densities.elliptical.rao import informative_barycenter, rao_distance_scalar
from track_fusion.linalg import Array
from track_fusion.rules import FusedTracks, SourceTracks, get_rule

ELLIPTICAL = ("mhdp_explicit", "mhdp_iterative", "quasi_minimal_manhattan", "geodesic_projection")
MHDP = ELLIPTICAL[:2]


def fuse(key: str, mean: Any, cov: Any, dof: Any = None, **params: Any) -> FusedTracks:
    rule = get_rule(key)
    dof = None if dof is None else np.asarray(dof, float)
    return rule(SourceTracks(np.asarray(mean, float), np.asarray(cov, float), dof), rule.params(**params))


# The static example, section 5.1 -------------------------------------------------------------------------------------

#: family parameter, MHDP with squared criterion, FCI: distances to the midpoint of the geodesic.
STATIC = [
    ("student_t", 3.0, 0.0303, 0.0536),
    ("student_t", 5.0, 0.0319, 0.0540),
    ("student_t", 7.0, 0.0328, 0.0545),
    ("generalized_gaussian", 0.65, 0.0236, 0.0321),
    ("generalized_gaussian", 0.85, 0.0312, 0.0468),
    ("generalized_gaussian", 1.0, 0.0363, 0.0573),
]
EVERY_STATIC = pytest.mark.parametrize(("name", "shape", "mhdp", "fci"), STATIC, ids=[f"{s[0]}-{s[1]}" for s in STATIC])
MEANS, SCATTERS = np.array([2.0, 4.0]), np.array([5.0, 7.0])


def _static(name: str, shape: float) -> tuple[Family, dict[str, Any], Callable[[float, float], float]]:
    """Return the family, the tracks with parameters that say it, and the distance of (mean, cov) to the midpoint."""
    family = student_t(shape, 1) if name == "student_t" else generalized_gaussian(shape, 1)
    tracks: dict[str, Any] = {"mean": MEANS[:, None], "cov": family.kappa * SCATTERS[:, None, None]}
    tracks |= {"dof": [shape, shape]} if name == "student_t" else {"family": name, "beta": shape}
    middle = informative_barycenter(family, MEANS, SCATTERS)
    assert middle[0] == pytest.approx(2.91608, abs=5e-6)

    def distance(mean: float, cov: float) -> float:
        return float(rao_distance_scalar(family, *middle, np.asarray(mean), np.asarray(cov / family.kappa)))

    return family, tracks, distance


def _halfway(cov: Array) -> tuple[float, float]:
    """Fast covariance intersection of the static example: equal divergence to both Gaussians."""

    def at(w: float) -> tuple[float, float]:
        info = w / cov[0] + (1 - w) / cov[1]
        return (w * MEANS[0] / cov[0] + (1 - w) * MEANS[1] / cov[1]) / info, 1 / info

    def excess(w: float) -> float:
        mean, fused = at(w)
        first, second = (fused / c - math.log(fused / c) + (mean - m) ** 2 / c for m, c in zip(MEANS, cov, strict=True))
        return float(first - second)

    return at(brentq(excess, 0.0, 1.0, xtol=1e-14))


@EVERY_STATIC
def test_static_example(name: str, shape: float, mhdp: float, fci: float) -> None:
    family, tracks, distance = _static(name, shape)
    both = [fuse(key, **tracks) for key in MHDP]
    for fused in both:
        assert distance(fused.mean[0], fused.cov[0, 0]) == pytest.approx(mhdp, abs=1e-4)
        assert (fused.dof is None) == (name != "student_t")
    assert both[0].cov[0, 0] == pytest.approx(both[1].cov[0, 0], rel=1e-12)
    halfway = _halfway(tracks["cov"][:, 0, 0])
    assert distance(*halfway) == pytest.approx(fci, abs=1e-4)
    fast = fuse("fast_covariance_intersection", tracks["mean"], tracks["cov"])
    np.testing.assert_allclose((fast.mean[0], fast.cov[0, 0]), halfway, rtol=1e-9)


@EVERY_STATIC
def test_mhdp_is_closest_to_the_barycenter(name: str, shape: float, mhdp: float, fci: float) -> None:
    """Figure 2: closer than every rule of the form of an intersection, once squared distances are minimised."""
    family, tracks, distance = _static(name, shape)
    others = [_halfway(tracks["cov"][:, 0, 0])]
    for key, params in (("quasi_minimal_manhattan", {}), ("geodesic_projection", {"family": "gaussian"})):
        given = tracks if key.startswith("quasi") else {k: tracks[k] for k in ("mean", "cov")} | params
        fused = fuse(key, **given)
        others.append((fused.mean[0], fused.cov[0, 0]))
    for criterion in ("det", "uniform"):
        fused = fuse("covariance_intersection", tracks["mean"], tracks["cov"], criterion=criterion)
        others.append((fused.mean[0], fused.cov[0, 0]))
    assert mhdp < min(distance(m, c) for m, c in others)


@EVERY_STATIC
def test_unsquared_static_example_collapses_onto_one_sensor(name: str, shape: float, mhdp: float, fci: float) -> None:
    _, tracks, distance = _static(name, shape)
    for key in MHDP:
        fused = fuse(key, **tracks, criterion="unsquared")
        assert fused.mean[0] == 2.0
        assert fused.info["snapped"] == 0
        assert fused.info["converged"]
        np.testing.assert_array_equal(fused.weights, [1.0, 0.0])
        assert distance(fused.mean[0], fused.cov[0, 0]) > distance(*_halfway(tracks["cov"][:, 0, 0]))


# The mean ------------------------------------------------------------------------------------------------------------


def _objective(mean: Array, cov: Array, pull: float, squared: bool) -> Callable[[Array], float]:
    infos = np.linalg.inv(cov)

    def value(x: Array) -> float:
        half = np.einsum("ki,kij,kj->k", x - mean, infos, x - mean) * pull / 2.0
        terms = 2.0 * np.arcsinh(np.sqrt(half))  # arccosh(1 + 2 half), with its digits near zero
        return float((terms**2 if squared else terms).sum())

    return value


def _searched(value: Callable[[Array], float], mean: Array) -> float:
    """Lowest value that a grid over the estimates' surroundings and a simplex search from its best points find."""
    low, high = mean.min(0) - 0.5, mean.max(0) + 0.5
    grid = np.stack(np.meshgrid(*np.linspace(low, high, 41).T, indexing="ij"), -1).reshape(-1, mean.shape[1])
    values = np.array([value(x) for x in grid])
    starts = [*grid[np.argsort(values)[:4]], *mean]
    options = {"xatol": 1e-9, "fatol": 1e-13, "maxiter": 2000}
    return min(minimize(value, s, method="Nelder-Mead", options=options).fun for s in starts)


@pytest.mark.parametrize("squared", [True, False])
@pytest.mark.parametrize("spread", [0.3, 3.0, 20.0])
def test_mean_is_the_global_minimum(squared: bool, spread: float) -> None:
    """Spread estimates have several local minima; a search over a grid finds none lower."""
    rng = np.random.default_rng(1)
    for count in (2, 3, 4):
        mean, cov = spread * rng.normal(size=(count, 2)), covariances(rng, count, n=2)
        value = _objective(mean, cov, 0.5, squared)
        found = nearest_mean(mean[None], cov[None], np.array([0.5]), squared)
        assert found.converged.all()
        assert found.objective[0] == pytest.approx(value(found.mean[0]), rel=1e-9)
        assert found.objective[0] <= _searched(value, mean) * (1 + 1e-9)


def test_global_minimum_that_the_first_descent_misses() -> None:
    """Two groups far apart, the smaller nearer to the first start: only a start at an estimate finds the other."""
    rng = np.random.default_rng(2)
    missed = 0
    for _ in range(40):
        mean = np.where(np.arange(5)[:, None] < 3, 0.0, rng.normal(size=2) * 60.0) + rng.normal(size=(5, 2))
        cov = covariances(rng, 5, n=2) * np.exp(rng.normal(size=(5, 1, 1)))
        value = _objective(mean, cov, 0.5, True)
        start = np.linalg.solve(np.linalg.inv(cov).sum(0), np.linalg.solve(cov, mean[..., None])[..., 0].sum(0))
        first = minimize(value, start, method="BFGS").fun
        found = nearest_mean(mean[None], cov[None], np.array([0.5]), True).objective[0]
        local = [minimize(value, m, method="BFGS").fun for m in mean]
        assert found <= min(*local, first) * (1 + 1e-7)
        missed += first > found * (1 + 1e-3)
    assert missed >= 3


def test_snap_condition() -> None:
    """The mean is an estimate where the kink there holds it: sqrt(G' P G) <= sqrt(2 c); else it is none."""
    rng = np.random.default_rng(3)
    seen = []
    for _ in range(80):
        mean, cov, pull = rng.normal(size=(4, 2)) * rng.uniform(0.2, 4.0), covariances(rng, 4, n=2) / 4.0, 0.5
        found = nearest_mean(mean[None], cov[None], np.array([pull]), False)
        source = int(found.snapped[0])
        seen.append(source)
        if source < 0:
            gradient = minimize(_objective(mean, cov, pull, False), found.mean[0], method="BFGS").x
            np.testing.assert_allclose(gradient, found.mean[0], atol=1e-4)
            continue
        np.testing.assert_array_equal(found.mean[0], mean[source])
        pulls = np.zeros(2)
        for j in set(range(4)) - {source}:
            d = 1.0 + pull * (mean[source] - mean[j]) @ np.linalg.solve(cov[j], mean[source] - mean[j])
            pulls += 2 * pull * np.linalg.solve(cov[j], mean[source] - mean[j]) / math.sqrt(d**2 - 1)
        assert math.sqrt(pulls @ cov[source] @ pulls) <= math.sqrt(2 * pull)
    assert min(seen) == -1
    assert len(set(seen)) > 2


def test_several_estimates_at_one_place() -> None:
    """Coincident estimates hold the mean together where one alone would not; weights (48) are infinite at each."""
    mean = np.array([[[1.0, 1.0], [1.0, 1.0], [1.0, 1.0], [3.0, 0.0], [-2.0, 4.0]]])
    cov = np.broadcast_to(np.eye(2), (1, 5, 2, 2))
    found = nearest_mean(mean, cov, np.array([0.5]), False)
    np.testing.assert_array_equal(found.mean[0], [1.0, 1.0])
    assert found.objective[0] <= _searched(_objective(mean[0], cov[0], 0.5, False), mean[0]) + 1e-9
    same = nearest_mean(mean[:, :3], cov[:, :3], np.array([0.5]), True)
    np.testing.assert_allclose(same.mean[0], [1.0, 1.0], rtol=1e-15)
    assert same.objective[0] == 0.0


@pytest.mark.parametrize("key", ELLIPTICAL)
def test_far_apart_and_hard_tracks(key: str) -> None:
    """A million standard deviations apart, and vague where the other is sharp: finite, converged, definite."""
    sharp = np.stack([np.diag([1e-9, 1.0, 1e3]), np.diag([1.0, 1e-9, 1e3]), np.diag([1e2, 1e2, 1e-7])])
    for mean in (np.diag([1e6, 1e6, 1e6]), np.zeros((3, 3)), np.ones((3, 3)) * 1e-9 * np.arange(3)[:, None]):
        for cov in (sharp, np.broadcast_to(np.eye(3), (3, 3, 3))):
            fused = fuse(key, mean, cov)
            assert fused.info["converged"]
            assert np.isfinite(fused.mean).all()
            assert np.linalg.eigvalsh(fused.cov).min() > 0


# Families, dof and scatter -------------------------------------------------------------------------------------------


def _tracks(seed: int, count: int = 3, n: int = 3) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(6, count, n)), covariances(rng, 6, count, n=n)


@pytest.mark.parametrize("key", ELLIPTICAL)
def test_dof_to_infinity_gives_the_gaussian_result(key: str) -> None:
    mean, cov = _tracks(4)
    normal = fuse(key, mean, cov, family="student_t")
    assert normal.dof is None
    infinite = fuse(key, mean, cov, np.full((6, 3), np.inf), family="student_t")
    np.testing.assert_array_equal(infinite.mean, normal.mean)
    np.testing.assert_array_equal(infinite.dof, np.full(6, np.inf))
    gaps = []
    for dof in (10.0, 1e3, 1e5, 1e9):
        fused = fuse(key, mean, cov, np.full((6, 3), dof), family="student_t")
        np.testing.assert_array_equal(fused.dof, np.full(6, dof))
        gaps.append(float(np.abs(fused.mean - normal.mean).max() + np.abs(fused.cov - normal.cov).max()))
    assert gaps[0] > 10 * gaps[1] > 100 * gaps[2] > 0.0
    assert gaps[3] < 1e-7
    for same in ({"family": "gaussian"}, {"family": "generalized_gaussian", "beta": 1.0}):
        fused = fuse(key, mean, cov, np.full((6, 3), 3.0), **same)
        assert fused.dof is None
        np.testing.assert_allclose(fused.mean, normal.mean, rtol=0, atol=1e-9)
        np.testing.assert_allclose(fused.cov, normal.cov, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("key", ELLIPTICAL)
def test_the_least_dof_of_a_target_is_that_of_all_its_tracks(key: str) -> None:
    mean, cov = _tracks(5)
    dof = np.full((6, 3), np.inf)
    dof[:3, 1], dof[:3, 2] = 4.0, 9.0
    fused = fuse(key, mean, cov, dof, family="student_t")
    np.testing.assert_array_equal(fused.dof, [4.0, 4.0, 4.0, np.inf, np.inf, np.inf])
    for rows, nu in ((slice(3), 4.0), (slice(3, 6), np.inf)):
        alone = fuse(key, mean[rows], cov[rows], np.full((3, 3), nu), family="student_t")
        np.testing.assert_allclose(fused.mean[rows], alone.mean[:], rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(fused.cov[rows], alone.cov[:], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("key", ELLIPTICAL)
def test_beta_without_its_family(key: str) -> None:
    mean, cov = _tracks(6)
    default = get_rule(key).params().family  # type: ignore[attr-defined]
    with pytest.raises(ValueError) as caught:
        fuse(key, mean, cov, beta=0.5)
    text = f"The 'beta' parameter needs family 'generalized_gaussian'. Got family '{default}'."
    assert str(caught.value) == text
    with pytest.raises(ValueError, match=r"must exceed 0\.25"):
        fuse(key, mean[..., :1], cov[..., :1, :1], family="generalized_gaussian", beta=0.1)


def test_scatter_by_intersection() -> None:
    """Eq. (50) at the weights of the mean."""
    mean, cov = _tracks(7)
    for criterion in ("squared", "unsquared"):
        fused = fuse("mhdp_iterative", mean, cov, criterion=criterion, scatter="intersection")
        assert fused.weights is not None
        wanted = np.linalg.inv((fused.weights[..., None, None] * np.linalg.inv(cov)).sum(1))
        np.testing.assert_allclose(fused.cov, wanted, rtol=1e-9, atol=1e-12)
        other = fuse("mhdp_iterative", mean, cov, criterion=criterion)
        np.testing.assert_array_equal(fused.mean, other.mean)
        pulled = np.linalg.solve(cov, mean[..., None])[..., 0]
        fixed = (wanted @ (fused.weights[..., None] * pulled).sum(1)[..., None])[..., 0]
        np.testing.assert_allclose(fused.mean, fixed, rtol=1e-7, atol=1e-9)  # eq. (45)


def test_rules_follow_the_axes_or_do_not_by_the_number_in_the_docstring() -> None:
    """Off-diagonal covariance of two tracks at one mean, in metres, and with the first axis in millimetres."""
    cov = np.array([np.diag([4.0, 1.0]), [[1.0, 0.9], [0.9, 4.0]]])
    found = {}
    for unit in (1.0, 1000.0):
        scale = np.diag([unit, 1.0])
        for key in MHDP:
            fused = fuse(key, np.zeros((2, 2)), scale @ cov @ scale)
            found[key, unit] = fused.cov[0, 1] / unit
    rounded = {k: round(float(v), 2) for k, v in found.items()}
    assert rounded["mhdp_explicit", 1.0] == 0.42
    assert rounded["mhdp_explicit", 1000.0] == 0.82
    assert rounded["mhdp_iterative", 1.0] == rounded["mhdp_iterative", 1000.0] == 0.37


def test_geodesic_projection_minimises_its_distances() -> None:
    rng = np.random.default_rng(8)
    for count in (2, 4):
        mean, cov = rng.normal(size=(count, 2)), covariances(rng, count, n=2) / 3.0
        fused = fuse("geodesic_projection", mean, cov)
        value = _objective(mean, cov, 1.0, True)  # arccosh(1 + d_k)^2
        best = minimize(value, fused.mean + 0.3, method="BFGS", options={"gtol": 1e-9})
        np.testing.assert_allclose(fused.mean, best.x, atol=1e-6)
        assert fused.weights is not None
        wanted = np.linalg.inv((fused.weights[:, None, None] * np.linalg.inv(cov)).sum(0))
        np.testing.assert_allclose(fused.cov, wanted, rtol=1e-10)
    mean, cov = rng.normal(size=(5, 3, 1)), covariances(rng, 5, 3, n=1)
    one, other = fuse("geodesic_projection", mean, cov), fuse("mhdp_explicit", mean, cov)
    np.testing.assert_allclose(one.mean, other.mean, rtol=1e-9, atol=1e-9)  # in one axis there is one shape


def _manhattan_sum(family: Family, mean: Array, cov: Array, weights: Array) -> Array:
    """Sum of squared distances (28) to the intersection, for weights (..., K)."""
    infos = np.linalg.inv(cov)
    fused = np.linalg.inv(np.einsum("...k,kij->...ij", weights, infos))
    centre = np.einsum("...ij,...k,kjl,kl->...i", fused, weights, infos, mean)
    scatter = fused[..., None, :, :] / family.kappa
    lengths = distances.minimal_manhattan(family, mean, cov / family.kappa, centre[..., None, :], scatter)
    return np.asarray((lengths**2).sum(-1))


@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("spread", [0.5, 4.0])
def test_quasi_minimal_manhattan_against_a_search_of_the_weights(count: int, spread: float) -> None:
    """Grids over the simplex, each round a finer one about the best weights so far."""
    rng, family = np.random.default_rng(9), student_t(4.0, 2)
    for _ in range(3):
        mean, cov = spread * rng.normal(size=(count, 2)), covariances(rng, count, n=2)
        fused = fuse("quasi_minimal_manhattan", mean, cov, np.full(count, 4.0))
        assert fused.weights is not None
        axis = np.linspace(0.0, 1.0, 41)
        best, width = np.full(count - 1, 0.5), 0.5
        for _ in range(10):
            free = np.stack(np.meshgrid(*((b - width) + 2 * width * axis for b in best), indexing="ij"), -1)
            free = np.clip(free.reshape(-1, count - 1), 0.0, 1.0)
            grid = np.concatenate([free, 1.0 - free.sum(-1, keepdims=True)], -1)
            grid = grid[grid.min(-1) >= 0.0]
            values = _manhattan_sum(family, mean, cov, grid)
            best, width = grid[values.argmin()][:-1], width / 4.0
        assert _manhattan_sum(family, mean, cov, fused.weights) <= values.min() * (1 + 1e-9)


def test_quasi_minimal_manhattan_of_proportional_covariances() -> None:
    """All shapes equal: the kink of every path decides; the midpoint by symmetry."""
    cov = np.stack([np.eye(3), np.eye(3)]) * 2.0
    fused = fuse("quasi_minimal_manhattan", [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]], cov, [5.0, 5.0])
    np.testing.assert_allclose(fused.mean, [1.0, 0.0, 0.0], atol=1e-8)
    np.testing.assert_allclose(fused.cov, 2.0 * np.eye(3), rtol=1e-12)
    assert fused.info["converged"]
