"""Student-t filter against the joint density by quadrature; Gaussian-Student-t filter against its evidence bound."""

import numpy as np
import pytest
from filters.plain import Plain
from oracles import kalman
from scipy import stats
from scipy.integrate import trapezoid
from scipy.optimize import minimize
from scipy.special import betaln, digamma, gammaln

from track_fusion.filters.base import Gaussian
from track_fusion.filters.gaussian_student_t_mixture import GaussianStudentTMixture, MixtureNoiseParams
from track_fusion.filters.student_t import StudentT, cov_from_scatter, scatter_from_cov
from track_fusion.models.base import Transition
from track_fusion.models.measurement import LinearSensor

N = 4


def random_cov(rng, *shape):
    """Shape (..., n) -> (..., n, n)."""
    a = rng.normal(size=(*shape, shape[-1] + 2))
    return a @ np.swapaxes(a, -1, -2)


def student_update(mean, cov, dof, z, sensor):
    """Mean and covariance of the Student-t filter's posterior, and what was learned."""
    state, learned = StudentT().update(Gaussian(mean, cov, dof), z, sensor)
    assert state.dof is dof
    return state.mean, state.cov, learned


def mixture_update(mean, cov, z, sensor, params=None):
    return Plain(GaussianStudentTMixture(params or MixtureNoiseParams())).update(mean, cov, z, sensor)


@pytest.mark.parametrize("dof", [2.5, 3.0, 7.0])
@pytest.mark.parametrize("z", [0.3, 9.0])
def test_update_is_the_conditional_of_the_joint_density(dof, z):
    """x and z jointly Student-t: moments of p(x | z) and the density of z by a fine grid."""
    prior, noise, h, mean = 2.0, 0.7, 1.5, 0.4
    joint = np.array([[prior, h * prior], [h * prior, h * h * prior + noise]])
    density = stats.multivariate_t([mean, h * mean], joint * (dof - 2) / dof, dof)
    x = np.sinh(np.linspace(-14.0, 14.0, 400_001))
    values = density.pdf(np.stack([x, np.full_like(x, z)], -1))
    evidence = trapezoid(values, x)
    wanted = trapezoid(x * values, x) / evidence
    spread = trapezoid((x - wanted) ** 2 * values, x) / evidence
    sensor = LinearSensor(("a",), np.array([[h]]), np.array([[noise]]))
    found, cov, innovation = student_update(np.array([mean]), np.array([[prior]]), dof, np.array([z]), sensor)
    assert found[0] == pytest.approx(wanted, rel=1e-6)
    assert cov[0, 0] == pytest.approx(spread, rel=1e-6)
    assert innovation.posterior_dof == dof + 1
    assert innovation.log_likelihood == pytest.approx(np.log(evidence), abs=1e-7)


def test_likelihood_of_several_axes_is_scipys():
    rng = np.random.default_rng(0)
    cov, sensor = random_cov(rng, N), LinearSensor(("a", "b"), rng.normal(size=(2, N)), random_cov(rng, 2))
    mean, z, dof = rng.normal(size=N), rng.normal(size=2), 4.5
    spread = sensor.matrix @ cov @ sensor.matrix.T + sensor.noise
    wanted = stats.multivariate_t(sensor.matrix @ mean, spread * (dof - 2) / dof, dof).logpdf(z)
    assert student_update(mean, cov, dof, z, sensor)[2].log_likelihood == pytest.approx(wanted, rel=1e-11)


@pytest.mark.parametrize("dof", [np.inf, 1e9])
def test_infinite_dof_is_the_kalman_filter(dof):
    rng = np.random.default_rng(1)
    mean, cov, z = rng.normal(size=(5, N)), random_cov(rng, 5, N), rng.normal(size=(5, 2))
    sensor = LinearSensor(("a", "b"), rng.normal(size=(2, N)), random_cov(rng, 2))
    transition = Transition.linear(rng.normal(size=(N, N)), random_cov(rng, N))
    wanted = kalman.predict(mean, cov, transition.jacobian(mean), transition.noise(mean))
    wanted = kalman.update(*wanted, z, sensor.matrix, sensor.noise)
    found = student_update(*Plain(StudentT()).predict(mean, cov, transition), dof, z, sensor)
    np.testing.assert_allclose(found[0], wanted[0], rtol=1e-9)
    np.testing.assert_allclose(found[1], wanted[1], rtol=1e-6)
    np.testing.assert_allclose(found[2].log_likelihood, wanted[2].log_likelihood, rtol=1e-5)


def test_moment_matching_has_the_factor_of_the_errata():
    scatter, dof, measured = np.array([[2.0, 0.3], [0.3, 1.0]]), 3.0, 5.0
    factor = (dof - 2) * measured / (dof * (measured - 2))
    matched = scatter_from_cov(cov_from_scatter(scatter, measured), dof)
    np.testing.assert_allclose(matched, factor * scatter, rtol=1e-13)
    np.testing.assert_allclose(cov_from_scatter(scatter, 3.0), 3.0 * scatter, rtol=1e-13)
    np.testing.assert_array_equal(scatter_from_cov(scatter, np.inf), scatter)


def test_covariance_and_scatter_forms_agree():
    """Huang's recursion written for scatters: (nu + D) / (nu + m) (P - K S K'), then the factor."""
    rng, dof = np.random.default_rng(2), 3.0
    mean, scatter = rng.normal(size=N), random_cov(rng, N)
    h, r, z = rng.normal(size=(2, N)), random_cov(rng, 2), 5.0 * rng.normal(size=2)
    s = h @ scatter @ h.T + r
    k = scatter @ h.T @ np.linalg.inv(s)
    square = (z - h @ mean) @ np.linalg.solve(s, z - h @ mean)
    wanted = (dof + square) / (dof + 2) * (scatter - k @ s @ k.T) * (dof - 2) * (dof + 2) / (dof * dof)
    sensor = LinearSensor(("a", "b"), h, dof / (dof - 2) * r)
    _, cov, _ = student_update(mean, dof / (dof - 2) * scatter, dof, z, sensor)
    np.testing.assert_allclose(scatter_from_cov(cov, dof), wanted, rtol=1e-9)


def test_dof_of_two_is_refused():
    sensor = LinearSensor(("a",), np.eye(1), np.eye(1))
    with pytest.raises(ValueError, match="The 'dof' of a Student-t state must exceed 2. Got 2."):
        student_update(np.zeros(1), np.eye(1), np.array([3.0, 2.0]), np.zeros(1), sensor)


def bound(theta, mean, prior, z, h, noise, p):
    """Lower bound on log p(z) of the model in the module's docstring, one axis, from its factors' parameters."""
    m, log_v, logit_y, logit_t, *logs = theta
    v, ey, et = np.exp(log_v), 1 / (1 + np.exp(-logit_y)), 1 / (1 + np.exp(-logit_t))
    total = 0.5 * np.log(2 * np.pi * np.e * v)
    squares = (((m - mean) ** 2 + v) / prior, ((z - h * m) ** 2 + h * h * v) / noise)
    for e, square, scale, (la, lb, lc, ld) in zip((ey, et), squares, (prior, noise), (logs[:4], logs[4:]), strict=True):
        a, b, c, d = np.exp([la, lb, lc, ld])  # Gamma(a, b) of the scale, Beta(c, d) of the probability
        mean_scale, log_scale = a / b, digamma(a) - np.log(b)
        log_p, log_q = digamma(c) - digamma(c + d), digamma(d) - digamma(c + d)
        total += -0.5 * np.log(2 * np.pi * scale) - 0.5 * e * square
        total += 0.5 * (1 - e) * (log_scale - mean_scale * square)
        total += e * log_p + (1 - e) * log_q - e * np.log(e) - (1 - e) * np.log(1 - e)
        total += 0.5 * p.dof * np.log(0.5 * p.dof) - gammaln(0.5 * p.dof)
        total += (0.5 * p.dof - 1) * log_scale - 0.5 * p.dof * mean_scale
        total += a - np.log(b) + gammaln(a) + (1 - a) * digamma(a)
        total += (p.gaussian_count - 1) * log_p + (p.student_count - 1) * log_q
        total -= betaln(p.gaussian_count, p.student_count)
        total += betaln(c, d) - (c - 1) * digamma(c) - (d - 1) * digamma(d) + (c + d - 2) * digamma(c + d)
    return total


@pytest.mark.parametrize("z", [1.0, 6.0, 40.0])
def test_mixture_update_is_a_maximum_of_the_evidence_bound(z):
    """Maximised by BFGS over all factors' parameters from the found state: the found state is where it ends."""
    params, args = MixtureNoiseParams(), (0.5, 2.0, z, 1.3, 0.8)
    sensor = LinearSensor(("a",), np.array([[1.3]]), np.array([[0.8]]))
    mean, cov, robust = mixture_update(np.array([0.5]), np.array([[2.0]]), np.array([z]), sensor, params)
    assert robust.converged.all()

    def logit(e):
        return np.log(e) - np.log1p(-e)

    start = [mean[0], np.log(cov[0, 0]), logit(robust.state_share), logit(robust.noise_share), *np.zeros(8)]
    # The bound's maximum over the scales' and probabilities' factors at the found state, then over everything.
    inner = minimize(
        lambda x: -bound([*start[:4], *x], *args, params), start[4:], method="BFGS", options={"gtol": 1e-9}
    )
    both = minimize(lambda x: -bound(x, *args, params), [*start[:4], *inner.x], method="BFGS", options={"gtol": 1e-7})
    assert -both.fun == pytest.approx(-inner.fun, abs=1e-6)
    np.testing.assert_allclose(both.x[:2], start[:2], atol=2e-3)


def test_outliers_move_the_state_little():
    """Kalman follows a measurement 100 sd off; the robust filter nearly ignores it, and uses a good one in full."""
    sensor, mean, cov = LinearSensor(("a",), np.eye(1), np.eye(1)), np.zeros((2, 1)), np.eye(1)
    z = np.array([[100.0], [1.0]])
    found, spread, robust = mixture_update(mean, np.tile(cov, (2, 1, 1)), z, sensor)
    plain, _, _ = kalman.update(mean, cov, z, np.eye(1), np.eye(1))
    # Which of the two is the outlier is not known: prediction and measurement are equally suspect here.
    assert plain[0, 0] == pytest.approx(50.0)
    assert robust.state_share[0] < 0.01 or robust.noise_share[0] < 0.01
    assert robust.noise_share[1] > 0.8
    assert found[1, 0] == pytest.approx(plain[1, 0], abs=0.05)
    trusting = MixtureNoiseParams(gaussian_count=1e9, student_count=1e-9)
    same, same_cov, _ = mixture_update(mean, np.tile(cov, (2, 1, 1)), z, sensor, trusting)
    np.testing.assert_allclose(same[1], plain[1], rtol=1e-6)
    assert same_cov[1, 0, 0] == pytest.approx(0.5, rel=1e-6)
    assert spread.shape == (2, 1, 1)


def contaminated(rng, shape, sd, share):
    return sd * rng.normal(size=shape) * np.where(rng.random((*shape[:-1], 1)) < share, np.sqrt(200.0), 1.0)


@pytest.mark.parametrize(("intensity", "share", "bound"), [(1.0, 0.1, 1.05), (0.01, 0.0, 0.9)])
def test_robust_filters_beat_kalman_where_one_noise_in_ten_is_an_outlier(intensity, share, bound):
    """Chen 2022, 5.2, and with outliers of the measurement alone: root-mean-square and median position error.

    With both noises contaminated an outlier of the one looks like one of the other, and the mixture filter's few
    wrong guesses cost as much, in the square, as the right ones gain.
    """
    rng, runs, steps = np.random.default_rng(3), 200, 40
    f, g = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])
    sensor = LinearSensor(("x",), np.array([[1.0, 0.0]]), np.array([[16.0]]))
    heavy = LinearSensor(("x",), sensor.matrix, 3.0 * sensor.noise)  # nominal values are scatters of t(3)
    noise = intensity * g @ g.T + 1e-6 * np.eye(2)
    nominal = Transition.linear(f, noise)
    wide = Transition.linear(f, 3.0 * noise)
    cov = np.tile(np.diag([10.0, 25.0]), (runs, 1, 1))
    truth = np.array([0.0, 5.0]) + rng.normal(size=(runs, 2)) * np.sqrt([10.0, 25.0])
    states = {name: (np.tile([0.0, 5.0], (runs, 1)), cov) for name in ("kalman", "student", "mixture")}
    states["student"] = (states["student"][0], 3.0 * cov)
    errors, student, mixture = {name: [] for name in states}, Plain(StudentT()), Plain(GaussianStudentTMixture())
    for _ in range(steps):
        truth = truth @ f.T + contaminated(rng, (runs, 1), np.sqrt(intensity), share) @ g.T
        z = truth[:, :1] + contaminated(rng, (runs, 1), 4.0, 0.1)
        mean, cov = kalman.predict(*states["kalman"], f, noise)
        states["kalman"] = kalman.update(mean, cov, z, sensor.matrix, sensor.noise)[:2]
        states["student"] = student_update(*student.predict(*states["student"], wide), 3.0, z, heavy)[:2]
        states["mixture"] = mixture_update(*mixture.predict(*states["mixture"], nominal), z, sensor)[:2]
        for name, (mean, _) in states.items():
            errors[name].append(np.abs(mean - truth)[:, 0])
    rms = {name: np.sqrt(np.mean(np.square(e))) for name, e in errors.items()}
    middle = {name: np.median(e) for name, e in errors.items()}
    assert rms["student"] < 0.9 * rms["kalman"]
    assert rms["mixture"] < bound * rms["kalman"]
    assert middle["student"] < 0.9 * middle["kalman"]
    assert middle["mixture"] < 0.8 * middle["kalman"]


@pytest.mark.parametrize("lead", [(), (1,), (3, 2), (0,)])
def test_batch_equals_loop(lead):
    rng = np.random.default_rng(4)
    mean, cov, z = rng.normal(size=(*lead, N)), random_cov(rng, *lead, N), 5.0 * rng.normal(size=(*lead, 2))
    sensor = LinearSensor(("a", "b"), rng.normal(size=(2, N)), random_cov(rng, 2))
    dof = 3.0 + rng.random(lead)
    student = student_update(mean, cov, dof, z, sensor)
    mixture = mixture_update(mean, cov, z, sensor)
    assert mixture[2].converged.shape == lead
    for i in np.ndindex(lead):
        alone = student_update(mean[i], cov[i], dof[i], z[i], sensor)
        np.testing.assert_allclose(student[1][i], alone[1], rtol=1e-10)
        robust = mixture_update(mean[i], cov[i], z[i], sensor)
        np.testing.assert_allclose(mixture[0][i], robust[0], rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(mixture[1][i], robust[1], rtol=1e-6, atol=1e-9)


def test_mixture_update_in_a_batch_equals_it_alone():
    """Each stops when its own precisions have settled: the share of a gross outlier is zero long before its scale."""
    sensor = LinearSensor(("a",), np.array([[1.0, 0.0]]), np.eye(1))
    mean, cov = np.zeros((4, 2)), np.tile(np.array([[2.0, 0.4], [0.4, 1.0]]), (4, 1, 1))
    z = np.array([[0.1], [7.0], [100.0], [1e4]])
    together, spread, robust = mixture_update(mean, cov, z, sensor)
    for i in range(4):
        alone, alone_cov, one = mixture_update(mean[i], cov[i], z[i], sensor)
        np.testing.assert_array_equal(alone, together[i])
        np.testing.assert_array_equal(alone_cov, spread[i])
        assert one.converged == robust.converged[i]
        longer = mixture_update(mean[i], cov[i], z[i], sensor, MixtureNoiseParams(max_iterations=10_000, tolerance=0.0))
        np.testing.assert_allclose(longer[0], alone, rtol=1e-7)
        np.testing.assert_allclose(longer[1], alone_cov, rtol=1e-7)
