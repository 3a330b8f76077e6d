"""The particle filter: against Kalman by many particles, resampling laws, and independence of the batch."""

import numpy as np
import pytest
from oracles import kalman
from scipy.stats import chi2, kstest, multivariate_normal

from track_fusion.filters import particle
from track_fusion.filters.particle import RESAMPLING, Particles, Sir, SirParams, SirState
from track_fusion.models.measurement import LinearSensor, RangeBearingSensor
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.models.turn import CoordinatedTurn, CoordinatedTurnParams
from track_fusion.random_streams import exponentials, normals, uniforms
from track_fusion.tracks import StateLayout, planar_layout

SCHEMES = pytest.mark.parametrize("scheme", RESAMPLING)


def weighted(rng, *shape):
    """Random particles in two axes."""
    weight = rng.dirichlet(np.full(shape[-1], 0.5), shape[:-1])
    with np.errstate(divide="ignore"):
        return Particles(rng.normal(size=(*shape, 2)), np.log(weight))


@SCHEMES
def test_many_particles_are_the_kalman_filter(scheme):
    """Mean, covariance and likelihood over five steps, within five standard errors of 20 repeats."""
    layout, repeats = planar_layout(), 20
    motion, sensor = NearlyConstantVelocity(layout, MotionParams(process_noise=3.0)), LinearSensor.position(layout, 3.0)
    mean, cov = np.array([1.0, 2.0, 3.0, 4.0]), np.diag([20.0, 20.0, 9.0, 9.0])
    one = Sir(SirParams(particles=4000, resampling=scheme))
    cloud = one.begin(np.tile(mean, (repeats, 1)), np.tile(cov, (repeats, 1, 1)))
    for k in range(5):
        z = np.array([4.0 * k + 5.0, 5.0 * k - 2.0])
        mean, cov = kalman.predict(mean, cov, *motion.matrices(1.0))
        mean, cov, innovation = kalman.update(mean, cov, z, sensor.matrix, sensor.noise)
        cloud, learned = one.update(one.predict(cloud, motion.over(1.0)), z, sensor)
        found_mean, found_cov = cloud.moments
        likelihoods = learned.log_likelihood, innovation.log_likelihood
        for found, wanted in ((found_mean, mean), (found_cov, cov), likelihoods):
            error = found.std(0, ddof=1) / np.sqrt(repeats)
            assert (np.abs(found.mean(0) - wanted) < 5 * error + 0.01 * np.abs(wanted).max()).all()
            assert (error < 0.05 * np.abs(wanted).max()).all()


def weigh(cloud, z, sensor):
    """Weighed particles, and the log-likelihood of what was seen."""
    found, learned = Sir().update(SirState(cloud.points, cloud.log_weight, np.random.default_rng(0)), z, sensor)
    return found, learned.log_likelihood


def test_weights_are_the_normalised_likelihoods():
    rng = np.random.default_rng(1)
    cloud, noise = weighted(rng, 3, 50), np.array([[2.0, 0.5], [0.5, 1.0]])
    sensor, z = LinearSensor(("x", "y"), np.array([[1.0, 2.0], [0.0, 3.0]]), noise), rng.normal(size=(3, 2))
    found, likelihood = weigh(cloud, z, sensor)
    for r in range(3):
        each = [multivariate_normal(sensor.matrix @ x, noise).pdf(z[r]) for x in cloud.points[r]] * cloud.weight[r]
        np.testing.assert_allclose(found.weight[r], each / each.sum(), rtol=1e-9, atol=1e-300)
        assert likelihood[r] == pytest.approx(np.log(each.sum()), rel=1e-10)


def test_weights_survive_where_likelihoods_underflow():
    cloud = Particles(np.array([[0.0], [1.0], [2.0]]), np.full(3, -np.log(3.0)))
    found, likelihood = weigh(cloud, np.array([1e4]), LinearSensor(("x",), np.eye(1), np.eye(1)))
    np.testing.assert_allclose(found.weight, [0.0, 0.0, 1.0], atol=1e-300)
    assert likelihood == pytest.approx(-0.5 * 9998.0**2 - 0.5 * np.log(2 * np.pi) - np.log(3.0), rel=1e-12)


def test_bearings_across_the_cut_are_near():
    sensor = RangeBearingSensor(StateLayout(("x", "y")), 1.0, 0.01)
    cloud = Particles(np.array([[-100.0, 0.5], [-100.0, -0.5], [100.0, 0.5]]), np.full(3, -np.log(3.0)))
    weight = weigh(cloud, np.array([100.0, np.pi]), sensor)[0].weight
    np.testing.assert_allclose(weight, [0.5, 0.5, 0.0], atol=1e-12)


@SCHEMES
def test_resampling_keeps_the_mean_number_of_copies(scheme):
    """Each particle appears M w_i times on average; systematic: to within one, every time."""
    rng, repeats, size, count = np.random.default_rng(2), 4000, 7, 11
    weight = np.array([0.3, 0.0, 0.02, 0.4, 0.08, 0.2, 0.0])
    with np.errstate(divide="ignore"):
        cloud = Particles(np.arange(7.0)[:, None], np.log(weight))
    many = Particles(np.tile(cloud.points, (repeats, 1, 1)), np.tile(cloud.log_weight, (repeats, 1)))
    drawn = RESAMPLING[scheme](many, rng, count)
    assert drawn.points.shape == (repeats, count, 1)
    np.testing.assert_allclose(drawn.weight, 1 / count, rtol=1e-12)
    copies = (drawn.points[..., 0][:, None] == np.arange(size)[:, None]).sum(-1)
    expected = count * weight
    if scheme == "systematic":
        assert (np.abs(copies - expected) < 1.0 + 1e-9).all()
        spread = np.sqrt((expected % 1) * (1 - expected % 1))
    else:
        spread = np.sqrt(expected * (1 - weight))
        # Multinomial: the variance of each count, and chi-square of the first repeats' counts.
        np.testing.assert_allclose(copies.std(0), spread, rtol=0.06, atol=1e-12)
    assert (np.abs(copies.mean(0) - expected) <= 5 * spread / np.sqrt(repeats) + 1e-12).all()
    assert not copies[:, weight == 0].any()


def test_multinomial_draws_are_independent_of_each_other():
    """Counts of equal weights: chi-square of a multinomial over many repeats."""
    rng, repeats, size = np.random.default_rng(3), 2000, 5
    cloud = Particles(np.tile(np.arange(5.0)[:, None], (repeats, 1, 1)), np.full((repeats, size), -np.log(size)))
    points = particle.resample_multinomial(cloud, rng, 40).points[..., 0]
    copies = (points[:, None] == np.arange(size)[:, None]).sum(-1)
    statistic = ((copies - 8.0) ** 2 / 8.0).sum(1)
    assert kstest(statistic, chi2(size - 1).cdf).statistic < 0.06


@SCHEMES
def test_a_single_heavy_particle_takes_all(scheme):
    cloud = Particles(np.arange(4.0)[:, None], np.array([-np.inf, 0.0, -np.inf, -np.inf]))
    drawn = RESAMPLING[scheme](cloud, np.random.default_rng(4), 100)
    np.testing.assert_array_equal(drawn.points, np.full((100, 1), 1.0))


def test_union_is_the_mixture_of_the_sets():
    rng = np.random.default_rng(5)
    sets, weights = [weighted(rng, 3, 40), weighted(rng, 3, 60)], np.array([0.3, 0.7])
    joined = particle.union(sets, weights)
    assert joined.points.shape == (3, 100, 2)
    np.testing.assert_allclose(joined.weight.sum(-1), 1.0, rtol=1e-12)
    mean, cov = joined.moments
    for r in range(3):
        points = np.concatenate([s.points[r] for s in sets])
        weight = np.concatenate([w * s.weight[r] for w, s in zip(weights, sets, strict=True)])
        np.testing.assert_allclose(mean[r], np.average(points, axis=0, weights=weight), rtol=1e-10)
        np.testing.assert_allclose(cov[r], np.cov(points.T, aweights=weight, ddof=0), rtol=1e-10)


def test_moments_keep_their_digits_far_from_the_origin():
    rng = np.random.default_rng(6)
    near = weighted(rng, 50)
    far = Particles(near.points + 2.0**30, near.log_weight)
    np.testing.assert_allclose(far.moments[1], near.moments[1], rtol=1e-6)


def steps(runs, seed=3, count=64):
    """Two steps of everything that draws, for these runs."""
    layout = StateLayout(("x", "y", "vx", "vy", "turn_rate"))
    transition = CoordinatedTurn(layout, CoordinatedTurnParams()).over(1.0)
    sensor = RangeBearingSensor(layout, 10.0, 0.02)
    mean, cov = np.array([300.0, 100.0, 5.0, 2.0, 0.01]), np.diag([100.0, 100.0, 4.0, 4.0, 1e-3])
    ones = [Sir(SirParams(seed=seed, role="filter", particles=count, resampling=r), tuple(runs)) for r in RESAMPLING]
    cloud = ones[0].begin(np.tile(mean, (len(runs), 1)), np.tile(cov, (len(runs), 1, 1)))
    for one in ones:
        cloud, _ = one.update(one.predict(cloud, transition), np.array([310.0, 0.3]), sensor)
        cloud = one.adopt(cloud, cloud)
    return cloud.points


def test_results_do_not_depend_on_the_batch():
    together = steps(range(5))
    for run in range(5):
        np.testing.assert_array_equal(steps([run])[0], together[run])
    np.testing.assert_array_equal(steps([3, 1]), together[[3, 1]])
    assert len(np.unique(together[:, 0, 0])) == 5
    assert steps([]).shape == (0, 64, 5)


def test_one_generator_serves_a_single_run():
    params = SirParams(seed=3, role="filter", particles=10)
    single = Sir(params).begin(np.zeros(2), np.eye(2))
    batched = Sir(params, (0,)).begin(np.zeros((1, 2)), np.eye(2)[None])
    np.testing.assert_array_equal(single.points, batched.points[0])


@pytest.mark.parametrize(
    ("draw", "law"),
    [(normals, "norm"), (uniforms, "uniform"), (exponentials, "expon")],
    ids=lambda x: x if isinstance(x, str) else x.__name__,
)
def test_draws_have_their_law_and_one_generator_a_run(draw, law):
    rng = [np.random.default_rng(i) for i in range(4)]
    drawn = draw(rng, (4, 1000))
    assert kstest(drawn.ravel(), law).pvalue > 1e-4
    np.testing.assert_array_equal(drawn[2], draw(np.random.default_rng(2), (1000,)))
    with pytest.raises(ValueError, match=r"There must be one generator for each of the runs, shape \(3,\). Got 4."):
        draw(rng, (3, 5))
