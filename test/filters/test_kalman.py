"""The Kalman filter against one big joint Gaussian, and against chi-square."""

import numpy as np
import pytest
from filters.plain import predict, update
from scipy.linalg import block_diag
from scipy.stats import chi2, multivariate_normal

from track_fusion.models.measurement import LinearSensor
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.tracks import planar_layout

N = 4


def random_cov(rng, *shape):
    """Shape (..., n) -> (..., n, n)."""
    a = rng.normal(size=(*shape, shape[-1] + 2))
    return a @ np.swapaxes(a, -1, -2)


@pytest.mark.parametrize("seed", range(5))
def test_equals_conditioning_the_joint_gaussian_of_all_states_and_measurements(seed):
    rng = np.random.default_rng(seed)
    steps, m = 4, 2
    fs, hs = rng.normal(size=(steps, N, N)), rng.normal(size=(steps, m, N))
    qs, rs = random_cov(rng, steps, N), random_cov(rng, steps, m)
    mean0, cov0, zs = rng.normal(size=N), random_cov(rng, N), rng.normal(size=(steps, m))

    # Everything is a linear map of the independent noises (x0, w1..wT, v1..vT).
    noise_cov = block_diag(cov0, *qs, *rs)
    state = np.eye(N, len(noise_cov))
    rows, offset = [], []
    bias = mean0
    for k in range(steps):
        state = fs[k] @ state
        state[:, N * (k + 1) : N * (k + 2)] += np.eye(N)
        bias = fs[k] @ bias
        measured = hs[k] @ state
        start = N * (steps + 1) + m * k
        measured[:, start : start + m] += np.eye(m)
        rows.append(measured)
        offset.append(hs[k] @ bias)
    seen = np.concatenate(rows)
    szz, sxz = seen @ noise_cov @ seen.T, state @ noise_cov @ seen.T
    gain = np.linalg.solve(szz, sxz.T).T
    wanted_mean = bias + gain @ (zs.ravel() - np.concatenate(offset))
    wanted_cov = state @ noise_cov @ state.T - gain @ sxz.T
    evidence = multivariate_normal(np.concatenate(offset), szz).logpdf(zs.ravel())

    mean, cov, total = mean0, cov0, 0.0
    for k in range(steps):
        mean, cov = predict(mean, cov, fs[k], qs[k])
        mean, cov, innovation = update(mean, cov, zs[k], hs[k], rs[k])
        total += innovation.log_likelihood
    np.testing.assert_allclose(mean, wanted_mean, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(cov, wanted_cov, rtol=1e-6, atol=1e-8)
    assert total == pytest.approx(evidence, rel=1e-8)


def test_joint_update_equals_one_sensor_after_the_other():
    rng = np.random.default_rng(1)
    mean, cov = rng.normal(size=(6, N)), random_cov(rng, 6, N)
    hs = [rng.normal(size=(m, N)) for m in (1, 2, 3)]
    rs = [random_cov(rng, m) for m in (1, 2, 3)]
    zs = [rng.normal(size=(6, m)) for m in (1, 2, 3)]
    joint_mean, joint_cov, innovation = update(mean, cov, np.concatenate(zs, -1), np.concatenate(hs), block_diag(*rs))
    total = np.zeros(6)
    for z, h, r in zip(zs, hs, rs, strict=True):
        mean, cov, one = update(mean, cov, z, h, r)
        total += one.log_likelihood
    np.testing.assert_allclose(joint_mean, mean, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(joint_cov, cov, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(innovation.log_likelihood, total, rtol=1e-9)


@pytest.mark.parametrize("axes", [(), (1,), (3, 2), (0,)])
def test_batch_equals_loop(axes):
    rng = np.random.default_rng(2)
    mean, cov = rng.normal(size=(*axes, N)), random_cov(rng, *axes, N)
    f, q = rng.normal(size=(*axes, N, N)), random_cov(rng, *axes, N)
    z, h, r = rng.normal(size=(*axes, 2)), rng.normal(size=(*axes, 2, N)), random_cov(rng, *axes, 2)
    predicted = predict(mean, cov, f, q)
    posterior = update(*predicted, z, h, r)
    assert posterior[0].shape == mean.shape
    assert posterior[1].shape == cov.shape
    assert posterior[2].nis.shape == axes
    for i in np.ndindex(axes):
        alone = update(*predict(mean[i], cov[i], f[i], q[i]), z[i], h[i], r[i])
        np.testing.assert_allclose(posterior[0][i], alone[0], rtol=1e-12)
        np.testing.assert_allclose(posterior[1][i], alone[1], rtol=1e-12)
        np.testing.assert_allclose(posterior[2].nis[i], alone[2].nis, rtol=1e-12)


def test_one_covariance_serves_a_batch_of_means():
    rng = np.random.default_rng(3)
    mean, cov = rng.normal(size=(5, N)), random_cov(rng, N)
    z, h, r = rng.normal(size=(5, 2)), rng.normal(size=(2, N)), np.eye(2)
    shared = update(mean, cov[None], z, h, r)
    full = update(mean, np.tile(cov, (5, 1, 1)), z, h, r)
    assert shared[1].shape == (1, N, N)
    np.testing.assert_allclose(shared[0], full[0], rtol=1e-12)
    np.testing.assert_allclose(shared[2].nis, full[2].nis, rtol=1e-12)


def test_covariance_stays_definite_where_a_sensor_is_a_million_times_sharper():
    cov, h, r = np.diag([1e8, 1e8, 1e4, 1e4]), np.eye(2, N), 1e-6 * np.eye(2)
    mean = np.zeros(N)
    for _ in range(50):
        mean, cov, _ = update(mean, cov, np.zeros(2), h, r)
        assert np.linalg.eigvalsh(cov).min() > 0
        np.testing.assert_array_equal(cov, cov.T)
    np.testing.assert_allclose(np.diag(cov)[:2], 1e-6 / 50, rtol=1e-4)


def _consistency_of_filter(claimed_noise_sd):
    """Mean NEES and NIS over independent runs, at the last of 20 steps, of a filter that assumes this sensor."""
    rng = np.random.default_rng(4)
    runs, layout = 500, planar_layout()
    motion = NearlyConstantVelocity(layout, MotionParams(process_noise=2.0))
    f, q = motion.matrices(0.5)
    factor = motion.noise_factor(0.5)
    truth_sensor, assumed = LinearSensor.position(layout, 3.0), LinearSensor.position(layout, claimed_noise_sd)
    cov = np.diag([25.0, 25.0, 4.0, 4.0])
    mean = np.zeros((runs, N))
    truth = rng.normal(size=(runs, N)) * np.sqrt(np.diag(cov))
    for _ in range(20):
        truth = truth @ f.T + rng.normal(size=(runs, factor.shape[1])) @ factor.T
        z = truth @ truth_sensor.matrix.T + 3.0 * rng.normal(size=(runs, 2))
        mean, cov = predict(mean, cov, f, q)
        mean, cov, innovation = update(mean, cov, z, assumed.matrix, assumed.noise)
    error = mean - truth
    return (error * np.linalg.solve(cov, error.T).T).sum(1).mean(), innovation.nis.mean(), runs


def test_filter_is_consistent_by_nees_and_nis():
    nees, nis, runs = _consistency_of_filter(3.0)
    for value, axes in ((nees, 4), (nis, 2)):
        low, high = chi2.ppf([1e-4, 1 - 1e-4], runs * axes) / runs
        assert low < value < high


def test_the_consistency_test_notices_a_wrong_noise():
    nees, _, runs = _consistency_of_filter(2.0)
    assert nees > chi2.ppf(1 - 1e-6, runs * 4) / runs
