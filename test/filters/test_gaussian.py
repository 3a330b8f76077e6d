"""Extended, unscented and (square-root) cubature filters: the linear case, exact moments, quadrature, consistency."""

import itertools

import numpy as np
import pytest
from filters.plain import Plain, update
from mpmath import mp
from scipy.linalg import block_diag
from scipy.stats import chi2, multivariate_normal

from track_fusion.filters.cubature import Cubature
from track_fusion.filters.extended import Extended
from track_fusion.filters.iterated_corrector import IteratedCorrector
from track_fusion.filters.square_root_cubature import GaussianRoot, SquareRootCubature, triangular_root
from track_fusion.filters.unscented import Unscented, UnscentedParams
from track_fusion.models.base import Transition
from track_fusion.models.measurement import LinearSensor, RangeBearingSensor
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.models.turn import CoordinatedTurn, CoordinatedTurnParams
from track_fusion.tracks import StateLayout, planar_layout

N = 4


FILTERS = {
    "extended": Plain(Extended()),
    "unscented": Plain(Unscented()),
    "cubature": Plain(Cubature()),
    "root": Plain(SquareRootCubature()),
}
SIGMA = {name: FILTERS[name] for name in ("unscented", "cubature", "root")}


def random_cov(rng, *shape):
    """Shape (..., n) -> (..., n, n)."""
    a = rng.normal(size=(*shape, shape[-1] + 2))
    return a @ np.swapaxes(a, -1, -2)


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("seed", range(3))
def test_linear_models_give_the_joint_gaussian_of_all_states_and_measurements(name, seed):
    rng, steps = np.random.default_rng(seed), 3
    fs, hs = rng.normal(size=(steps, N, N)), rng.normal(size=(steps, 2, N))
    qs, rs = random_cov(rng, steps, N), random_cov(rng, steps, 2)
    mean0, cov0, zs = rng.normal(size=N), random_cov(rng, N), rng.normal(size=(steps, 2))
    # Everything is a linear map of the independent (x0, w1..wT).
    state, bias, rows, offset = np.eye(N, N * (steps + 1)), mean0, [], []
    for k in range(steps):
        state, bias = fs[k] @ state, fs[k] @ bias
        state[:, N * (k + 1) : N * (k + 2)] += np.eye(N)
        rows.append(hs[k] @ state)
        offset.append(hs[k] @ bias)
    seen, noise = np.concatenate(rows), block_diag(cov0, *qs)
    szz, sxz = seen @ noise @ seen.T + block_diag(*rs), state @ noise @ seen.T
    gain = np.linalg.solve(szz, sxz.T).T
    wanted = bias + gain @ (zs.ravel() - np.concatenate(offset)), state @ noise @ state.T - gain @ sxz.T
    evidence = multivariate_normal(np.concatenate(offset), szz).logpdf(zs.ravel())

    mean, cov, total, one = mean0, cov0, 0.0, FILTERS[name]
    for k in range(steps):
        mean, cov = one.predict(mean, cov, Transition.linear(fs[k], qs[k]))
        mean, cov, innovation = one.update(mean, cov, zs[k], LinearSensor(("a", "b"), hs[k], rs[k]))
        total += innovation.log_likelihood
    np.testing.assert_allclose(mean, wanted[0], rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(cov, wanted[1], rtol=1e-6, atol=1e-8)
    assert total == pytest.approx(evidence, rel=1e-8)


@pytest.mark.parametrize("name", FILTERS)
def test_one_sensor_after_the_other_equals_the_joint_update_when_linear(name):
    rng = np.random.default_rng(1)
    mean, cov = rng.normal(size=(6, N)), random_cov(rng, 6, N)
    hs, rs = [rng.normal(size=(m, N)) for m in (1, 2)], [random_cov(rng, m) for m in (1, 2)]
    zs = [rng.normal(size=(6, m)) for m in (1, 2)]
    joint = update(mean, cov, np.concatenate(zs, -1), np.concatenate(hs), block_diag(*rs))
    sensors = [LinearSensor(tuple("ab"[: len(r)]), h, r) for h, r in zip(hs, rs, strict=True)]
    one = FILTERS[name].one
    posterior, learned = IteratedCorrector(one).update(one.begin(mean, cov), zs, sensors)
    np.testing.assert_allclose(posterior.moments[0], joint[0], rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(posterior.moments[1], joint[1], rtol=1e-7, atol=1e-10)
    np.testing.assert_allclose(learned.log_likelihood, joint[2].log_likelihood, rtol=1e-9)


def quadrature(mean, cov, order=30):
    """Gauss-Hermite points (P, n) and weights of a Gaussian."""
    x, w = np.polynomial.hermite_e.hermegauss(order)
    grid = np.array(list(itertools.product(x, repeat=len(mean))))
    weight = np.prod(list(itertools.product(w / w.sum(), repeat=len(mean))), 1)
    return mean + grid @ np.linalg.cholesky(cov).T, weight


@pytest.mark.parametrize("name", SIGMA)
def test_means_of_cubic_functions_are_exact(name):
    """The rules are exact to the third degree, so E f is exact for cubic f, and E f f' for linear f only."""
    rng = np.random.default_rng(2)
    mean, cov = rng.normal(size=3), random_cov(rng, 3)
    a, b, c = rng.normal(size=(3, 3)), rng.normal(size=(3, 3, 3)), rng.normal(size=(3, 3, 3, 3))

    def cubic(x):
        return x @ a.T + np.einsum("ijk,...j,...k", b, x, x) + np.einsum("ijkl,...j,...k,...l", c, x, x, x)

    points, weight = quadrature(mean, cov, 6)
    transition = Transition.additive(cubic, lambda x: x, np.eye(3), np.eye(3))
    found, _ = SIGMA[name].predict(mean, cov, transition)
    np.testing.assert_allclose(found, weight @ cubic(points), rtol=1e-10)


def test_unscented_with_three_minus_n_gets_the_variance_of_a_square():
    """In one axis kappa = 2 makes the points those of Gauss-Hermite of order 3: x^2 has variance 4 m^2 P + 2 P^2."""
    mean, cov = np.array([1.5]), np.array([[0.7]])
    square = Transition.additive(lambda x: x**2, lambda x: 2 * x[..., None], np.array([[0.3]]), np.array([[1.0]]))
    _, found = Plain(Unscented(UnscentedParams(kappa=2.0))).predict(mean, cov, square)
    assert found[0, 0] == pytest.approx(4 * 1.5**2 * 0.7 + 2 * 0.7**2 + 0.3, rel=1e-12)
    _, too_small = FILTERS["cubature"].predict(mean, cov, square)
    assert too_small[0, 0] == pytest.approx(4 * 1.5**2 * 0.7 + 0.3, rel=1e-12)


def test_unscented_without_a_centre_is_the_cubature_filter():
    rng = np.random.default_rng(3)
    layout = planar_layout()
    mean, cov = np.array([300.0, 200.0, 1.0, 2.0]), 20.0 * random_cov(rng, N)
    sensor, centreless = RangeBearingSensor(layout, 5.0, 0.1), Plain(Unscented(UnscentedParams(kappa=0.0)))
    a, b = (one.update(mean, cov, np.array([350.0, 0.6]), sensor) for one in (centreless, FILTERS["cubature"]))
    np.testing.assert_allclose(a[0], b[0], rtol=1e-12)
    np.testing.assert_allclose(a[1], b[1], rtol=1e-11, atol=1e-11)


def test_unscented_refuses_points_on_top_of_each_other():
    with pytest.raises(ValueError, match="The 'kappa' parameter must exceed -n = -3. Got -3."):
        Unscented(UnscentedParams(kappa=-3.0)).points(3)


@pytest.mark.parametrize("name", SIGMA)
def test_moments_of_a_sensor_are_near_those_of_quadrature(name):
    """The posterior mean is the Gaussian one at the moments of (x, h(x)): there, by 30 points an axis."""
    sensor = RangeBearingSensor(StateLayout(("x", "y")), 10.0, 0.02, (40.0, -30.0))
    mean, cov, z = np.array([300.0, 100.0]), np.array([[150.0, 30.0], [30.0, 90.0]]), np.array([310.0, 0.5])
    points, weight = quadrature(mean, cov)
    seen = sensor.observe(points)
    expected = weight @ seen
    spread = (weight[:, None] * (seen - expected)).T @ (seen - expected) + sensor.noise
    cross = (weight[:, None] * (points - mean)).T @ (seen - expected)
    gain = np.linalg.solve(spread, cross.T).T
    found_mean, found_cov, innovation = SIGMA[name].update(mean, cov, z, sensor)
    np.testing.assert_allclose(innovation.residual, z - expected, rtol=1e-3)
    np.testing.assert_allclose(found_mean, mean + gain @ (z - expected), atol=0.02)
    np.testing.assert_allclose(found_cov, cov - gain @ cross.T, rtol=5e-3, atol=0.1)


@pytest.mark.parametrize("name", FILTERS)
def test_the_posterior_tends_to_the_true_one_as_the_prior_sharpens(name):
    """True posterior by a grid; errors in units of its spread fall with the spread of the prior."""
    sensor, worst = RangeBearingSensor(StateLayout(("x", "y")), 1.0, 0.02), []
    for scale in (6.0, 1.5):
        mean, cov = np.array([60.0, 25.0]), scale**2 * np.array([[1.0, 0.3], [0.3, 0.8]])
        z = sensor.observe(mean + scale * np.array([0.5, -0.4]))
        side = np.linspace(-6.0, 6.0, 241)
        grid = mean + scale * np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
        log = multivariate_normal(mean, cov).logpdf(grid)
        log += multivariate_normal(np.zeros(2), sensor.noise).logpdf(sensor.residual(z, sensor.observe(grid)))
        weight = np.exp(log - log.max())
        weight /= weight.sum()
        true = weight @ grid
        true_cov = (weight[:, None] * (grid - true)).T @ (grid - true)
        found, found_cov, _ = FILTERS[name].update(mean, cov, z, sensor)
        error = np.linalg.solve(np.linalg.cholesky(true_cov), found - true)
        worst.append((np.abs(error).max(), np.abs(np.linalg.solve(true_cov, found_cov) - np.eye(2)).max()))
    assert worst[1][0] < 0.05
    assert worst[1][0] < 0.5 * worst[0][0]
    assert worst[1][1] < 0.05


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("side", [np.pi - 0.01, -np.pi + 0.01])
def test_bearings_across_the_cut(name, side):
    """Turning the whole scene by half a turn changes nothing: the cut at +-pi leaves no trace."""
    layout = planar_layout()
    turn = -np.eye(N)
    sensor = RangeBearingSensor(layout, 5.0, 0.02)
    mean, cov = np.array([-400.0, 1.0, 3.0, 4.0]), np.diag([900.0, 900.0, 25.0, 25.0])
    z = np.array([390.0, side])
    opposite = np.array([390.0, side - np.sign(side) * np.pi])
    here, there = FILTERS[name].update(mean, cov, z, sensor), FILTERS[name].update(turn @ mean, cov, opposite, sensor)
    np.testing.assert_allclose(here[0], turn @ there[0], rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(here[1], there[1], rtol=1e-8, atol=1e-8)
    assert abs(here[0][1]) < 10.0


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("axes", [(), (1,), (3, 2), (0,)])
def test_batch_equals_loop(name, axes):
    rng = np.random.default_rng(4)
    layout = StateLayout(("x", "y", "vx", "vy", "turn_rate"))
    transition = CoordinatedTurn(layout, CoordinatedTurnParams()).over(0.5)
    sensor = RangeBearingSensor(layout, 5.0, 0.02, (-300.0, 0.0))
    mean = np.array([300.0, 100.0, 20.0, 5.0, 0.1]) + rng.normal(size=(*axes, 5)) * [50.0, 50.0, 5.0, 5.0, 0.05]
    cov = random_cov(rng, *axes, 5) * np.outer([5.0, 5.0, 1.0, 1.0, 0.02], [5.0, 5.0, 1.0, 1.0, 0.02])
    z = sensor.observe(mean) + rng.normal(size=(*axes, 2)) * [5.0, 0.02]
    copies = mean.copy(), cov.copy(), z.copy()
    one = FILTERS[name]
    predicted = one.predict(mean, cov, transition)
    posterior = one.update(*predicted, z, sensor)
    assert posterior[0].shape == mean.shape
    assert posterior[1].shape == cov.shape
    assert posterior[2].log_likelihood.shape == axes
    for i in np.ndindex(axes):
        alone = one.update(*one.predict(mean[i], cov[i], transition), z[i], sensor)
        np.testing.assert_allclose(posterior[0][i], alone[0], rtol=1e-11)
        np.testing.assert_allclose(posterior[1][i], alone[1], rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(posterior[2].nis[i], alone[2].nis, rtol=1e-10)
    for now, before in zip((mean, cov, z), copies, strict=True):
        np.testing.assert_array_equal(now, before)


def exact_variances(cov, sensor, updates):
    """Diagonal of the Kalman posterior after equal updates, by 60 digits."""
    mp.dps = 60
    info = mp.matrix(cov.tolist()) ** -1
    h, r = mp.matrix(sensor.matrix.tolist()), mp.matrix(sensor.noise.tolist())
    posterior = (info + updates * h.T * r**-1 * h) ** -1
    return np.array([float(posterior[i, i]) for i in range(len(cov))])


def test_the_root_survives_where_the_covariance_does_not():
    """Two axes almost equal (1 - 1e-14 correlated) and a sharp sensor: condition 1e22, beyond a matrix of doubles."""
    root = np.array([[1e6, 0.0, 0.0], [1e6, 0.1, 0.0], [3.0, -2.0, 1e-3]])
    sensor = LinearSensor(("a",), np.array([[1.0, 0.0, 0.0]]), np.array([[1e-6]]))
    z, state = np.zeros(1), GaussianRoot(np.zeros(3), root)
    for _ in range(5):
        state, _ = SquareRootCubature().update(state, z, sensor)
    mp.dps = 60
    exact = mp.matrix(root.tolist())
    exact = exact * exact.T
    column = exact[:, 0]
    exact = exact - column * column.T / (exact[0, 0] + mp.mpf(1e-6) / 5)
    variances = np.array([float(exact[i, i]) for i in range(3)])
    np.testing.assert_allclose((state.root**2).sum(1), variances, rtol=1e-5)
    # As a matrix of doubles the same covariance has lost its smallest axis already.
    lost = np.linalg.eigvalsh(root @ root.T)[0]
    assert not lost == pytest.approx(np.linalg.svd(root, compute_uv=False)[-1] ** 2, rel=0.1)


def test_sharp_updates_keep_the_covariance_definite():
    cov, sensor = np.diag([1e8, 1e8, 1e4, 1e4]), LinearSensor(("x", "y"), np.eye(2, N), 1e-6 * np.eye(2))
    wanted = exact_variances(cov, sensor, 20)
    for one in (FILTERS["cubature"], FILTERS["root"]):
        mean, posterior = np.zeros(N), cov
        for _ in range(20):
            mean, posterior, _ = one.update(mean, posterior, np.zeros(2), sensor)
            assert np.linalg.eigvalsh(posterior).min() > 0
        np.testing.assert_allclose(np.diag(posterior), wanted, rtol=1e-6)


def test_triangular_root():
    rng = np.random.default_rng(5)
    wide = rng.normal(size=(3, 4, 7))
    root = triangular_root(wide)
    np.testing.assert_allclose(root @ np.swapaxes(root, -1, -2), wide @ np.swapaxes(wide, -1, -2), rtol=1e-12)
    np.testing.assert_array_equal(np.triu(root, 1), np.zeros_like(root))
    assert (np.diagonal(root, axis1=1, axis2=2) > 0).all()


@pytest.mark.parametrize("name", FILTERS)
def test_filters_are_consistent_where_bearings_curve_little(name):
    """Mean NEES over independent runs lies in its chi-square bounds; with a wrong sensor it does not."""
    rng, runs, layout = np.random.default_rng(6), 300, planar_layout()
    transition = NearlyConstantVelocity(layout, MotionParams(process_noise=1.0)).over(1.0)
    sensor = RangeBearingSensor(layout, 5.0, 0.01)
    cov0 = np.diag([100.0, 100.0, 25.0, 25.0])
    start = np.array([600.0, 200.0, -20.0, 10.0])
    truth = start + rng.normal(size=(runs, N)) * np.sqrt(np.diag(cov0))
    seen = []
    for _ in range(10):
        truth = transition.advance(truth) + rng.normal(size=(runs, N)) @ transition.noise_factor(truth).T
        seen.append(sensor.observe(truth) + rng.normal(size=(runs, 2)) * np.sqrt(np.diag(sensor.noise)))

    def mean_nees(assumed):
        mean, cov = np.tile(start, (runs, 1)), np.tile(cov0, (runs, 1, 1))
        for z in seen:
            mean, cov = FILTERS[name].predict(mean, cov, transition)
            mean, cov, _ = FILTERS[name].update(mean, cov, z, assumed)
        return np.einsum("bi,bij,bj->b", mean - truth, np.linalg.inv(cov), mean - truth).mean()

    low, high = chi2.ppf([1e-4, 1 - 1e-4], runs * N) / runs
    assert low < mean_nees(sensor) < high
    assert mean_nees(RangeBearingSensor(layout, 3.0, 0.006)) > high
