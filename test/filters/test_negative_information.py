"""Mixtures conditioned on detections and on their absence, against a grid; the classes of a view cone."""

import numpy as np
import pytest

from track_fusion.densities.mixture.mixture import Mixture
from track_fusion.filters.negative_information import NegativeInformation
from track_fusion.models.detection import SoftmaxDetector
from track_fusion.tracks import StateLayout, planar_layout

PLANE = StateLayout(("x", "y"))
CONE = SoftmaxDetector.view_cone(PLANE, (1.0, -0.5), 0.7, 1.5, np.radians(30.0), 4.0)
NO_DETECTION, DETECTION = np.array([0.0, 1.0, 1.0, 1.0]), np.array([1.0, 0.0, 0.0, 0.0])
PRIOR = Mixture(
    np.array([0.5, 0.3, 0.2]),
    np.array([[1.5, 0.2], [-2.0, 1.0], [4.0, 3.0]]),
    np.array([[[1.0, 0.3], [0.3, 0.5]], [[2.0, 0.0], [0.0, 0.3]], [[0.2, 0.0], [0.0, 0.2]]]),
)


def update(mixture, detector, chance, **params):
    return NegativeInformation(**params).update(mixture, chance, detector)


def grid(size=241, half=9.0):
    side = np.linspace(-half, half, size)
    points = np.stack(np.meshgrid(side, side, indexing="ij"), -1).reshape(-1, 2)
    return points, (side[1] - side[0]) ** 2


def density(mixture, points):
    total = np.zeros(len(points))
    for w, m, c in zip(mixture.weight, mixture.mean, mixture.cov, strict=True):
        gap = points - m
        square = np.einsum("si,ij,sj->s", gap, np.linalg.inv(c), gap)
        total += w * np.exp(-0.5 * square) / np.sqrt(np.linalg.det(2 * np.pi * c))
    return total


def triangle(points):
    """Tell which points lie in CONE's triangle."""
    tip, heading, reach, half = np.array([1.0, -0.5]), 0.7, 1.5, np.radians(30.0)
    along = (points - tip) @ [np.cos(heading), np.sin(heading)]
    across = (points - tip) @ [-np.sin(heading), np.cos(heading)]
    return (np.abs(across) < along * np.tan(half)) & (along < reach)


def test_class_zero_of_a_hard_cone_is_its_triangle():
    hard = SoftmaxDetector.view_cone(PLANE, (1.0, -0.5), 0.7, 1.5, np.radians(30.0), 4000.0)
    points = np.random.default_rng(0).uniform(-1.0, 4.0, (4000, 2))
    inside = np.exp(hard.log_probability(points)[:, 0]) > 0.5
    assert (inside == triangle(points)).mean() > 0.998
    assert 0.01 < inside.mean() < 0.2
    np.testing.assert_allclose(np.exp(CONE.log_probability(points)).sum(1), 1.0, rtol=1e-12)


def test_a_cone_looks_at_positions_wherever_they_stand():
    layout = StateLayout(("vy", "y", "vx", "x"))
    other = SoftmaxDetector.view_cone(layout, (1.0, -0.5), 0.7, 1.5, np.radians(30.0), 4.0)
    points = np.random.default_rng(1).normal(size=(5, 2))
    states = np.stack([points[:, 0] + 9, points[:, 1], points[:, 0] - 7, points[:, 0]], -1)
    np.testing.assert_allclose(other.log_probability(states), CONE.log_probability(points), rtol=1e-12)


@pytest.mark.parametrize("chance", [NO_DETECTION, DETECTION, np.array([0.2, 1.0, 1.0, 1.0])])
def test_moments_and_likelihood_against_a_grid(chance):
    points, cell = grid()
    posterior = density(PRIOR, points) * (np.exp(CONE.log_probability(points)) @ chance)
    evidence = posterior.sum() * cell
    mean = posterior @ points * cell / evidence
    cov = (posterior[:, None] * (points - mean)).T @ (points - mean) * cell / evidence
    found, info = update(PRIOR, CONE, chance)
    assert info.log_likelihood == pytest.approx(np.log(evidence), abs=0.01)
    whole = found.weight @ found.mean
    gap = found.mean - whole
    spread = np.einsum("c,cij->ij", found.weight, found.cov) + (found.weight[:, None] * gap).T @ gap
    np.testing.assert_allclose(whole, mean, atol=0.02)
    np.testing.assert_allclose(spread, cov, atol=0.02 * np.abs(cov).max())
    assert found.weight.sum() == pytest.approx(1.0)
    assert len(found.weight) == 3 * (chance > 0).sum()
    if chance is not DETECTION:
        # The mixture follows the posterior's shape: much nearer to it, in L1, than the prior.
        distance = np.abs(density(found, points) - posterior / evidence).sum() * cell
        before = np.abs(density(PRIOR, points) - posterior / evidence).sum() * cell
        assert distance < 0.6 * before


@pytest.mark.parametrize("steepness", [0.1, 1.0, 30.0])
@pytest.mark.parametrize("offset", [-3.0, 0.0, 6.0])
def test_binary_likelihood_of_one_gaussian_against_quadrature(steepness, offset):
    """P(class 1 | x) = 1 / (1 + exp(-s (x - 1) ...)): each class' mass, mean and variance along one axis."""
    detector = SoftmaxDetector(np.array([[0.0], [steepness]]), np.array([0.0, steepness * offset / 3.0]))
    prior = Mixture(np.ones(1), np.array([[0.5]]), np.array([[[2.0]]]))
    x = np.linspace(-15.0, 15.0, 60_001)
    normal = np.exp(-0.25 * (x - 0.5) ** 2) / np.sqrt(4 * np.pi) * (x[1] - x[0])
    for c in range(2):
        score = steepness * (x + offset / 3.0) * (1 if c == 0 else -1)
        product = normal / (1 + np.exp(np.clip(score, -700, 700)))
        mass, chance = product.sum(), np.eye(2)[c]
        mean = product @ x / mass
        found, info = update(prior, detector, chance, samples=2048)
        assert info.log_likelihood == pytest.approx(np.log(mass), abs=0.01)
        assert found.mean[0, 0] == pytest.approx(mean, abs=0.01)
        assert found.cov[0, 0, 0] == pytest.approx(product @ (x - mean) ** 2 / mass, rel=0.02)
        assert info.effective_share.min() > 0.03


def test_what_is_far_from_the_cone_stays_as_it_is():
    """A component that the camera cannot see keeps weight, mean and covariance after fifty empty looks."""
    far = Mixture(np.array([0.6, 0.4]), np.array([[-20.0, 5.0], [-22.0, -3.0]]), np.tile(np.eye(2), (2, 1, 1)))
    mixture, total = far, 0.0
    for seed in range(50):
        mixture, info = update(mixture, CONE, NO_DETECTION, seed=seed)
        best = np.sort(np.argsort(mixture.weight)[-2:])
        assert mixture.weight[best].sum() > 0.999
        mixture = Mixture(mixture.weight[best], mixture.mean[best], mixture.cov[best])
        total += float(info.log_likelihood)
    assert abs(total) < 0.05
    np.testing.assert_allclose(mixture.weight, far.weight, atol=0.02)
    np.testing.assert_allclose(mixture.mean, far.mean, atol=0.05)
    np.testing.assert_allclose(mixture.cov, far.cov, atol=0.1)


def test_improbable_classes_do_not_underflow():
    found, info = update(Mixture(np.ones(1), np.array([[-60.0, 0.0]]), np.eye(2)[None]), CONE, DETECTION, samples=1024)
    assert info.log_likelihood < -100.0
    assert np.isfinite(info.log_likelihood)
    assert np.linalg.eigvalsh(found.cov[0]).min() > 0


@pytest.mark.parametrize("lead", [(), (1,), (3, 2), (0,)])
def test_batch_equals_loop(lead):
    rng = np.random.default_rng(2)
    root = rng.normal(size=(*lead, 3, 2, 4))
    prior = Mixture(
        rng.dirichlet(np.ones(3), lead), 2.0 * rng.normal(size=(*lead, 3, 2)), root @ np.swapaxes(root, -1, -2)
    )
    whole, info = update(prior, CONE, NO_DETECTION, samples=64)
    assert whole.weight.shape == (*lead, 9)
    assert info.log_likelihood.shape == lead
    for i in np.ndindex(lead):
        one = Mixture(prior.weight[i], prior.mean[i], prior.cov[i])
        alone, single = update(one, CONE, NO_DETECTION, samples=64)
        np.testing.assert_allclose(whole.weight[i], alone.weight, rtol=1e-6)
        np.testing.assert_allclose(whole.mean[i], alone.mean, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(info.log_likelihood[i], single.log_likelihood, rtol=1e-6, atol=1e-9)


def test_a_state_with_velocity_is_conditioned_through_its_position():
    layout = planar_layout()
    cov = np.diag([1.0, 1.0, 4.0, 4.0])
    cov[0, 2] = cov[2, 0] = 1.5
    cone = SoftmaxDetector.view_cone(layout, (-1.0, 0.0), 0.0, 3.0, np.radians(60.0), 10.0)
    found, _ = update(Mixture(np.ones(1), np.zeros((1, 4)), cov[None]), cone, DETECTION, samples=8192)
    # E[v | event] = cov(v, p) cov(p)^-1 E[p | event].
    assert found.mean[0, 0] > 0.1
    assert found.mean[0, 2] == pytest.approx(1.5 * found.mean[0, 0], abs=0.02)
    assert found.mean[0, 3] == pytest.approx(0.0, abs=0.03)


@pytest.mark.parametrize("chance", [[1.0, 0.0], [0.0, 0.0, 0.0, 0.0], [1.2, 0.0, 0.0, 0.0], [-0.1, 1.0, 1.0, 1.0]])
def test_impossible_chances_are_refused(chance):
    with pytest.raises(ValueError, match="The 'chance' must hold 4 numbers from 0 to 1, not all 0. Got"):
        update(PRIOR, CONE, np.array(chance))


def test_components_that_the_event_hardly_touches_are_weighed_and_keep_their_shape():
    """Cutting what a cone does not touch makes nothing better."""
    points, cell = grid()
    prior = density(PRIOR, points)
    found, whole = update(PRIOR, CONE, NO_DETECTION, negligible=0.05)
    kept = found.weight.reshape(3, 3)[:, 1:].sum(1) == 0.0
    np.testing.assert_array_equal(kept, [False, True, True])
    np.testing.assert_array_equal(found.mean[[3, 6]], PRIOR.mean[1:])
    np.testing.assert_array_equal(found.cov[[3, 6]], PRIOR.cov[1:])
    likelihood = 1.0 - np.exp(CONE.log_probability(points)[:, 0])
    assert np.exp(whole.log_likelihood) == pytest.approx((prior * likelihood).sum() * cell, rel=2e-3)
    posterior = prior * likelihood / (prior * likelihood).sum() / cell
    everything, _ = update(PRIOR, CONE, NO_DETECTION)
    error, full = (np.abs(density(m, points) - posterior).sum() * cell for m in (found, everything))
    assert error < full + 0.002
    np.testing.assert_array_equal(update(PRIOR, CONE, NO_DETECTION, negligible=1e-12)[0].mean, everything.mean)


def test_components_are_kept_or_cut_by_themselves_within_a_batch():
    batch = Mixture(*(np.stack([a, a[::-1]]) for a in (PRIOR.weight, PRIOR.mean, PRIOR.cov)))
    found, _ = update(batch, CONE, NO_DETECTION, negligible=0.05)
    alone, _ = update(PRIOR, CONE, NO_DETECTION, negligible=0.05)
    np.testing.assert_allclose(found.weight[0], alone.weight, rtol=1e-12)
    np.testing.assert_allclose(found.mean[1].reshape(3, 3, 2)[::-1].reshape(9, 2), alone.mean, rtol=1e-12)
