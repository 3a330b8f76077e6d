"""The rules that subtract a common part from naive fusion: inverse and ellipsoidal intersection, harmonic mean."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from oracles.exact import blend, errors, exact, mp, mutual_fusion
from rules.examples import covariances, joint_covariances, rotated, scalar_nees
from scipy.optimize import minimize_scalar
from scipy.stats import multivariate_normal

from track_fusion.linalg import Array
from track_fusion.rules import FusedTracks, SourceTracks, get_rule

EPS = float(np.finfo(float).eps)
ICI, HMD, EI = "inverse_covariance_intersection", "harmonic_mean", "ellipsoidal_intersection"
WEIGHED = pytest.mark.parametrize("key", [ICI, HMD])
CRITERIA = pytest.mark.parametrize("criterion", ["det", "trace"])


def fuse(key: str, mean: Array, cov: Array, **params: Any) -> FusedTracks:
    rule = get_rule(key)
    return rule(SourceTracks(mean, cov), rule.params(**params))


def at(key: str, mean: Array, cov: Array, omega: float) -> FusedTracks:
    return fuse(key, mean, cov, criterion="given", weights=(omega, 1.0 - omega))


# The example (75)-(76) of Sharma --------------------------------------------------------------------------------------

EXAMPLE_MEAN = np.array([[0.5, 1.0], [2.0, 1.0]])
EXAMPLE_COV = np.array([[[2.5, -1.0], [-1.0, 1.2]], [[0.8, -0.5], [-0.5, 4.0]]])


@pytest.mark.parametrize(
    ("key", "determinant"), [("geometric_average", 1.583), (ICI, 0.879), (HMD, 0.759), (EI, 0.633), ("naive", 0.396)]
)
def test_determinants_of_the_example(key: str, determinant: float) -> None:
    """ERRATA.md: at omega .5, GMD = CI 1.583, ICI .879, HMD-GA .759, EI .633, naive .396."""
    given = {} if key in (EI, "naive") else {"criterion": "given", "weights": (0.5, 0.5)}
    fused = fuse(key, EXAMPLE_MEAN, EXAMPLE_COV, **given)
    assert np.linalg.det(fused.cov) == pytest.approx(determinant, abs=6e-4)


def _densities() -> tuple[Array, Array, Array]:
    axis = np.linspace(-16.0, 18.0, 681)
    points = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1)
    first, second = (multivariate_normal(m, c).pdf(points) for m, c in zip(EXAMPLE_MEAN, EXAMPLE_COV, strict=True))
    return points, first, second


def test_exact_harmonic_mean_of_the_example_on_a_grid() -> None:
    """ERRATA.md: determinant 1.093, which the Gaussian in the denominator makes too small."""
    points, first, second = _densities()
    density = np.divide(first * second, first + second, out=np.zeros_like(first), where=first + second > 0)
    density /= density.sum()
    centre = np.einsum("ij,ijk->k", density, points)
    cov = np.einsum("ij,ijk,ijl->kl", density, points - centre, points - centre)
    assert np.linalg.det(cov) == pytest.approx(1.093, abs=1e-3)
    fused = at(HMD, EXAMPLE_MEAN, EXAMPLE_COV, 0.5)
    assert np.linalg.det(fused.cov) < np.linalg.det(cov)
    assert np.linalg.norm(fused.mean - centre) < 0.5 * np.sqrt(np.linalg.eigvalsh(cov)[0])


@pytest.mark.parametrize("omega", [0.2, 0.5, 0.8])
def test_harmonic_mean_minimises_the_pearson_divergence(omega: float) -> None:
    """Sharma, Theorem 1, on a grid: among functions, and after normalisation among densities."""
    _, first, second = _densities()
    inside = np.minimum(first, second) > 1e-200
    first, second = first[inside], second[inside]
    harmonic = 1.0 / (omega / first + (1.0 - omega) / second)

    def divergence(p: Array) -> float:
        return float((omega * (p - first) ** 2 / first + (1.0 - omega) * (p - second) ** 2 / second).sum())

    least, density = divergence(harmonic), harmonic * (first.sum() / harmonic.sum())
    rng = np.random.default_rng(1)
    for _ in range(50):
        change = harmonic * rng.uniform(-0.3, 0.3, size=harmonic.shape)
        assert divergence(harmonic + change) > least
        change -= density * (change.sum() / density.sum())  # stays a density
        assert divergence(density + change) > divergence(density)
    assert divergence(density) < min(divergence(first), divergence(second))


# Oracles --------------------------------------------------------------------------------------------------------------


def _hard(kind: str, condition: float, rng: np.random.Generator) -> Array:
    if kind == "rotated":
        return np.stack([rotated(rng, rng.permutation(np.geomspace(1.0, condition, 4))) for _ in range(2)])
    axes = np.array([[1.0, 1.0, condition, condition], [condition, condition, 1.0, 1.0]])
    return np.stack([rotated(np.random.default_rng(7), d * rng.uniform(0.5, 2.0, 4)) for d in axes])


@WEIGHED
@pytest.mark.parametrize("omega", [None, 0.5, 0.1])
@pytest.mark.parametrize("condition", [1e2, 1e7, 1e13])
@pytest.mark.parametrize("kind", ["rotated", "complementary"])
def test_hard_pairs_against_mpmath(key: str, kind: str, condition: float, omega: float | None) -> None:
    rng = np.random.default_rng(2)
    cov, mean = _hard(kind, condition, rng), rng.normal(size=(2, 4))
    fused = fuse(key, mean, cov) if omega is None else at(key, mean, cov, omega)
    assert fused.weights is not None
    w = mp.mpf(float(fused.weights[0]))
    first, second, x1, x2 = exact(cov[0]), exact(cov[1]), exact(mean[0]), exact(mean[1])
    if key == ICI:
        common = blend(w, x1, x2), blend(w, first, second)
    else:  # the harmonic mean's weights stand on the other side
        offset = x1 - x2
        common = blend(1 - w, x1, x2), blend(1 - w, first, second) + w * (1 - w) * offset * offset.T
    tolerance = 1e-12 + 100 * EPS * condition
    assert max(errors(fused.mean, fused.cov, *mutual_fusion(mean, cov, *common))) <= tolerance
    assert np.linalg.eigvalsh(fused.cov).min() > 0.05


@pytest.mark.parametrize("condition", [1e2, 1e7, 1e13])
def test_ellipsoidal_intersection_against_the_paper_s_construction(condition: float) -> None:
    """P1 = S D S', D^-1/2 S' P2 S D^-1/2 = S2 D2 S2', C = S D^1/2 S2 max(D2, 1) S2' D^1/2 S', in 40 digits."""
    rng = np.random.default_rng(3)
    cov, mean = _hard("rotated", condition, rng), rng.normal(size=(2, 4))
    values, vectors = mp.eigsy(exact(cov[0]))
    root = vectors * mp.diag([mp.sqrt(v) for v in values])
    inner, turn = mp.eigsy(root**-1 * exact(cov[1]) * (root**-1).T)
    frame = root * turn
    common = frame * mp.diag([max(v, 1) for v in inner]) * frame.T
    # Sijs and Lazar's mean of the common part, whose regularisation is not needed where no eigenvalue is one.
    shares = [exact(c) ** -1 - common**-1 for c in cov]
    common_mean = (shares[0] + shares[1]) ** -1 * (shares[1] * exact(mean[0]) + shares[0] * exact(mean[1]))
    fused = fuse(EI, mean, cov)
    tolerance = 1e-12 + 100 * EPS * condition
    assert max(errors(fused.mean, fused.cov, *mutual_fusion(mean, cov, common_mean, common))) <= tolerance


def _value(matrix: Array, criterion: str) -> float:
    return float(np.linalg.slogdet(matrix)[1] if criterion == "det" else np.log(np.trace(matrix)))


@CRITERIA
@WEIGHED
@pytest.mark.parametrize("distance", [0.0, 1.0, 30.0])
def test_weights_against_scipy(key: str, criterion: str, distance: float) -> None:
    """(47) minimises the fused covariance, (77) the inverse of the denominator's."""
    rng = np.random.default_rng(4)
    mean, cov = distance * rng.normal(size=(30, 2, 4)), covariances(rng, 30, 2)
    fused = fuse(key, mean, cov, criterion=criterion)
    assert fused.weights is not None
    assert np.all(fused.info["converged"])
    for (x1, x2), (p1, p2), weights in zip(mean, cov, fused.weights, strict=True):

        def cost(w: float, x1: Array = x1, x2: Array = x2, p1: Array = p1, p2: Array = p2) -> float:
            if key == ICI:
                info = np.linalg.inv(p1) + np.linalg.inv(p2) - np.linalg.inv(w * p1 + (1.0 - w) * p2)
                return _value(np.linalg.inv(info), criterion)
            spread = (1.0 - w) * p1 + w * p2 + w * (1.0 - w) * np.outer(x1 - x2, x1 - x2)
            return _value(np.linalg.inv(spread), criterion)

        found = minimize_scalar(cost, bounds=(0.0, 1.0), method="bounded", options={"xatol": 1e-10})
        assert cost(weights[0]) <= found.fun + 1e-12
        assert cost(weights[0]) >= found.fun - 1e-7


def test_scalar_weight_in_closed_form() -> None:
    """ERRATA.md: omega = clip(.5 + (P2 - P1) / (2 d^2), 0, 1)."""
    rng = np.random.default_rng(5)
    mean, cov = 2.0 * rng.normal(size=(500, 2, 1)), rng.uniform(0.2, 4.0, size=(500, 2, 1, 1))
    wanted = np.clip(0.5 + (cov[:, 1] - cov[:, 0])[:, 0, 0] / (2.0 * (mean[:, 0] - mean[:, 1])[:, 0] ** 2), 0.0, 1.0)
    assert ((wanted > 0) & (wanted < 1)).mean() > 0.3
    for criterion in ("det", "trace"):
        fused = fuse(HMD, mean, cov, criterion=criterion)
        assert fused.weights is not None
        np.testing.assert_allclose(fused.weights[:, 0], wanted, atol=1e-9)


def test_scalar_inverse_intersection_is_the_better_track() -> None:
    """Sharma (79): of scalar tracks the optimal weight leaves only the sharper one."""
    fused = fuse(ICI, np.array([[1.0], [5.0]]), np.array([[[4.0]], [[9.0]]]))
    assert fused.weights is not None
    assert fused.mean[0] == pytest.approx(1.0)
    assert fused.cov[0, 0] == pytest.approx(4.0)
    assert tuple(fused.weights) == (0.0, 1.0)


# Laws -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("omega", [0.0, 0.3, 0.5, 1.0])
def test_equal_means_make_the_harmonic_mean_inverse_intersection_at_mirrored_weights(omega: float) -> None:
    rng = np.random.default_rng(6)
    mean = np.broadcast_to(rng.normal(size=(40, 1, 4)), (40, 2, 4))
    cov = covariances(rng, 40, 2)
    harmonic, inverse = at(HMD, mean, cov, omega), at(ICI, mean, cov, 1.0 - omega)
    np.testing.assert_allclose(harmonic.cov, inverse.cov, rtol=1e-10, atol=1e-11)
    np.testing.assert_allclose(harmonic.mean, inverse.mean, rtol=0, atol=1e-10)


@pytest.mark.parametrize("omega", [0.2, 0.5, 0.7])
def test_harmonic_mean_is_tighter_than_inverse_intersection_at_the_same_common_weights(omega: float) -> None:
    """ERRATA.md: it holds at mirrored weights, in the Loewner order, strictly along one direction; not otherwise."""
    rng = np.random.default_rng(7)
    mean, cov = rng.normal(size=(200, 2, 4)), covariances(rng, 200, 2)
    harmonic = at(HMD, mean, cov, omega).cov
    gap = np.linalg.eigvalsh(at(ICI, mean, cov, 1.0 - omega).cov - harmonic)
    assert gap.min() > -1e-9
    assert (gap[:, -1] > 1e-6).all()
    if omega != 0.5:
        assert np.linalg.eigvalsh(at(ICI, mean, cov, omega).cov - harmonic).min() < -1e-3


def test_inverse_intersection_is_conservative_under_its_structure_only() -> None:
    """A shared part C >= P1, P2 and nothing else, (54); of all admissible cross-covariances half break it."""
    rng = np.random.default_rng(8)
    worst, broken = [], []
    for _ in range(100):
        cov = covariances(rng, 2, n=2)
        probes = np.concatenate([np.eye(4), np.zeros((1, 4))]).reshape(5, 2, 2)
        fused = at(ICI, probes, np.broadcast_to(cov, (5, 2, 2, 2)), rng.uniform())
        gain, claim = fused.mean[:4].T, np.linalg.inv(np.linalg.cholesky(fused.cov[4]))

        def excess(joint: Array, gain: Array = gain, claim: Array = claim) -> Array:
            return np.linalg.eigvalsh(claim @ gain @ joint @ gain.T @ claim.T)[..., -1]

        low = np.sqrt(np.linalg.eigvals(np.linalg.solve(cov[0], cov[1])).real.max()) * cov[0] + cov[1]
        for scale in (1.0, 3.0, 1e6):  # above both
            common = scale * (low + covariances(rng, n=2))
            cross = cov[0] @ np.linalg.inv(common) @ cov[1]
            worst.append(excess(np.block([[cov[0], cross], [cross.T, cov[1]]])))
        broken.append((excess(joint_covariances(rng, cov, 20)) > 1.0 + 1e-9).mean())
    assert max(worst) <= 1.0 + 1e-9
    assert max(worst) > 0.8
    assert 0.35 < np.mean(broken) < 0.65


def test_ellipsoidal_intersection_takes_the_sharper_track_axis_by_axis() -> None:
    cov = np.stack([np.diag([1.0, 9.0, 2.0]), np.diag([4.0, 3.0, 2.0])])
    fused = fuse(EI, np.array([[1.0, 1.0, 1.0], [5.0, 5.0, 5.0]]), cov)
    np.testing.assert_allclose(fused.cov, np.diag([1.0, 3.0, 2.0]), atol=1e-14)
    np.testing.assert_allclose(fused.mean, [1.0, 5.0, 3.0], atol=1e-14)


def test_squared_errors_of_the_harmonic_mean_exceed_its_claim() -> None:
    """ERRATA.md: scalar NEES 1.09 with (77) at variance ratio 10 and rho .9; 1.16 at omega .5 and rho .99."""
    assert scalar_nees((1.0, 10.0), 0.9, {}) == pytest.approx(1.09, abs=5e-3)
    given = {"criterion": "given", "weights": (0.5, 0.5)}
    assert scalar_nees((1.0, 10.0), 0.99, given) == pytest.approx(1.16, abs=5e-3)


@WEIGHED
def test_weights_of_a_fold_are_products_along_the_way(key: str) -> None:
    rng = np.random.default_rng(9)
    mean, cov = rng.normal(size=(6, 3, 4)), covariances(rng, 6, 3)
    first = fuse(key, mean[:, :2], cov[:, :2])
    then = fuse(key, np.stack([first.mean, mean[:, 2]], 1), np.stack([first.cov, cov[:, 2]], 1))
    whole = fuse(key, mean, cov, **({"combine": "fold"} if key == HMD else {}))
    np.testing.assert_allclose(whole.cov, then.cov, rtol=1e-9)
    assert first.weights is not None
    assert then.weights is not None
    wanted = np.concatenate([first.weights * then.weights[:, :1], then.weights[:, 1:]], 1)
    np.testing.assert_allclose(whole.weights, wanted, atol=1e-9)
    given = fuse(key, mean, cov, criterion="given", weights=(0.2, 0.3, 0.5))
    np.testing.assert_allclose(given.weights, np.broadcast_to([0.2, 0.3, 0.5], (6, 3)), atol=1e-12)


@pytest.mark.parametrize("key", [ICI, HMD, EI])
def test_large_batches_are_worked_on_in_pieces_without_a_seam(key: str) -> None:
    rng = np.random.default_rng(10)
    mean, cov = rng.normal(size=(2100, 2, 4)), covariances(rng, 2100, 2)
    whole, part = fuse(key, mean, cov), fuse(key, mean[1000:1100], cov[1000:1100])
    np.testing.assert_allclose(whole.cov[1000:1100], part.cov, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(whole.mean[1000:1100], part.mean, rtol=1e-9, atol=1e-9)
