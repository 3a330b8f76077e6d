"""IMM and Gaussian-sum IMM against the enumeration of all mode histories."""

import itertools

import numpy as np
import pytest
from oracles import kalman
from scipy.stats import multivariate_normal

from track_fusion.densities.mixture.mixture import Mixture
from track_fusion.filters.gaussian_sum_modes import GaussianSumModes, MixtureModes
from track_fusion.filters.interacting_multiple_model import InteractingMultipleModel, Modes
from track_fusion.models.measurement import LinearSensor, RangeRangeRateSensor
from track_fusion.models.turn import KnownTurn, KnownTurnParams
from track_fusion.tracks import planar_layout

LAYOUT = planar_layout()
RATES = (0.0, 0.3, -0.5)
MOTIONS = [KnownTurn(LAYOUT, KnownTurnParams(turn_rate=w, process_noise=1.0 + i)) for i, w in enumerate(RATES)]
TRANSITIONS = [m.over(1.0) for m in MOTIONS]
CHAIN = np.array([[0.8, 0.15, 0.05], [0.1, 0.6, 0.3], [0.2, 0.1, 0.7]])
START = np.array([0.5, 0.3, 0.2])
SENSOR = LinearSensor.position(LAYOUT, 2.0)
MEAN, COV = np.array([10.0, -5.0, 4.0, 3.0]), np.diag([9.0, 9.0, 4.0, 4.0])
SEEN = np.array([[14.5, -1.0], [17.0, 2.5], [16.0, 8.0]])
IMM = InteractingMultipleModel(CHAIN)


def keep_all(mixture, count):
    raise AssertionError("nothing was to be reduced")


def histories(steps, jump_first):
    """Every sequence of modes: (probability of sequence, evidence, last mode, mean, cov), by plain Kalman filters.

    jump_first: m_k moves x_(k-1) to x_k, and m_0 precedes the first jump. Else m_(k-1) does.
    """
    for modes in itertools.product(range(3), repeat=steps + 1):
        weight = START[modes[0]] * np.prod([CHAIN[a, b] for a, b in itertools.pairwise(modes)])
        mean, cov, log = MEAN, COV, 0.0
        for k in range(steps):
            f, q = MOTIONS[modes[k + 1] if jump_first else modes[k]].matrices(1.0)
            mean, cov = f @ mean, f @ cov @ f.T + q
            s = cov[:2, :2] + SENSOR.noise
            log += multivariate_normal(mean[:2], s).logpdf(SEEN[k])
            gain = cov[:, :2] @ np.linalg.inv(s)
            mean, cov = mean + gain @ (SEEN[k] - mean[:2]), cov - gain @ s @ gain.T
        yield weight * np.exp(log), modes[-1], mean, cov


def enumerated(steps, jump_first):
    """Evidence, mode probabilities, mean and covariance of the exact posterior."""
    weight, last, mean, cov = (np.array(a) for a in zip(*histories(steps, jump_first), strict=True))
    share = weight / weight.sum()
    whole = share @ mean
    spread = np.einsum("h,hij->ij", share, cov) + (share[:, None] * (mean - whole)).T @ (mean - whole)
    return np.log(weight.sum()), [share[last == m].sum() for m in range(3)], whole, spread


@pytest.mark.parametrize("jump_first", [True, False])
@pytest.mark.parametrize("steps", [1, 2, 3])
def test_gaussian_sums_without_reduction_are_the_exact_posterior(steps, jump_first):
    modes = MixtureModes(START, Mixture(np.ones((3, 1)), np.tile(MEAN, (3, 1, 1)), np.tile(COV, (3, 1, 1, 1))))
    one, total = GaussianSumModes(CHAIN, 3**steps, keep_all, jump_first), 0.0
    for z in SEEN[:steps]:
        modes, learned = one.update(one.predict(modes, TRANSITIONS), z, SENSOR)
        total += learned.log_likelihood
    evidence, probability, mean, cov = enumerated(steps, jump_first)
    assert total == pytest.approx(evidence, rel=1e-10)
    np.testing.assert_allclose(modes.probability, probability, rtol=1e-9)
    np.testing.assert_allclose(modes.moments[0], mean, rtol=1e-9)
    np.testing.assert_allclose(modes.moments[1], cov, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(modes.marginal.weight.sum(-1), 1.0, rtol=1e-12)


@pytest.mark.parametrize("jump_first", [True, False])
def test_first_step_of_the_imm_is_exact_in_its_moments(jump_first):
    """From one Gaussian: with the jump first every mode stays Gaussian; else the merging keeps all first moments."""
    modes = InteractingMultipleModel(CHAIN, jump_first).predict(Modes.start(START, MEAN, COV), TRANSITIONS)
    parts = [(START @ CHAIN[:, j], j, j) for j in range(3)] if jump_first else [
        (START[i] * CHAIN[i, j], i, j) for i in range(3) for j in range(3)
    ]  # fmt: skip
    weight = np.array([p for p, _, _ in parts])
    moved = [(f @ MEAN, f @ COV @ f.T + q) for f, q in (MOTIONS[i].matrices(1.0) for _, i, _ in parts)]
    mean = weight @ [m for m, _ in moved]
    cov = sum(w * (c + np.outer(m - mean, m - mean)) for w, (m, c) in zip(weight, moved, strict=True))
    np.testing.assert_allclose(modes.probability, START @ CHAIN, rtol=1e-13)
    np.testing.assert_allclose(modes.moments[0], mean, rtol=1e-12)
    np.testing.assert_allclose(modes.moments[1], cov, rtol=1e-12, atol=1e-12)
    if jump_first:
        modes, learned = IMM.update(modes, SEEN[0], SENSOR)
        evidence, probability, mean, cov = enumerated(1, True)
        assert learned.log_likelihood == pytest.approx(evidence, rel=1e-11)
        np.testing.assert_allclose(modes.probability, probability, rtol=1e-10)
        np.testing.assert_allclose(modes.moments[1], cov, rtol=1e-9)


def test_imm_stays_near_the_enumeration():
    modes = Modes.start(START, MEAN, COV)
    for z in SEEN:
        modes, _ = IMM.update(IMM.predict(modes, TRANSITIONS), z, SENSOR)
    _, probability, mean, cov = enumerated(3, True)
    np.testing.assert_allclose(modes.probability, probability, atol=0.01)
    np.testing.assert_allclose(modes.moments[0], mean, atol=0.05 * np.sqrt(cov.max()))
    np.testing.assert_allclose(modes.moments[1], cov, atol=0.05 * cov.max())


def test_equal_modes_are_one_kalman_filter():
    modes, mean, cov = Modes.start(START, MEAN, COV), MEAN, COV
    for z in SEEN:
        modes, learned = IMM.update(IMM.predict(modes, [TRANSITIONS[1]] * 3), z, SENSOR)
        mean, cov = kalman.predict(mean, cov, *MOTIONS[1].matrices(1.0))
        mean, cov, innovation = kalman.update(mean, cov, z, SENSOR.matrix, SENSOR.noise)
        assert learned.log_likelihood == pytest.approx(innovation.log_likelihood, rel=1e-10)
    np.testing.assert_allclose(modes.moments[0], mean, rtol=1e-10)
    np.testing.assert_allclose(modes.moments[1], cov, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(modes.probability, START @ np.linalg.matrix_power(CHAIN, 3), rtol=1e-10)


def test_gaussian_sums_of_one_component_are_the_imm():
    """Reduced to the merged moments after each jump, as the IMM does."""

    def to_one(mixture, count):
        mean = (mixture.weight[..., None] * mixture.mean).sum(-2, keepdims=True)
        gap = mixture.mean - mean
        spread = mixture.cov + gap[..., :, None] * gap[..., None, :]
        cov = (mixture.weight[..., None, None] * spread).sum(-3, keepdims=True)
        return Mixture(np.ones((*mean.shape[:-1],)), mean, cov)

    modes = Modes.start(START, MEAN, COV)
    sums = MixtureModes(START, Mixture(np.ones((3, 1)), modes.mean[:, None], modes.cov[:, None]))
    one, other = InteractingMultipleModel(CHAIN, jump_first=False), GaussianSumModes(CHAIN, 1, to_one)
    for z in SEEN:
        modes, _ = one.update(one.predict(modes, TRANSITIONS), z, SENSOR)
        sums, _ = other.update(other.predict(sums, TRANSITIONS), z, SENSOR)
    np.testing.assert_allclose(sums.probability, modes.probability, rtol=1e-10)
    np.testing.assert_allclose(sums.mixture.mean[:, 0], modes.mean, rtol=1e-10)
    np.testing.assert_allclose(sums.mixture.cov[:, 0], modes.cov, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("jump_first", [True, False])
def test_reduced_by_runnalls_the_sums_stay_near_the_enumeration(jump_first):
    modes = MixtureModes(START, Mixture(np.ones((3, 1)), np.tile(MEAN, (3, 1, 1)), np.tile(COV, (3, 1, 1, 1))))
    one = GaussianSumModes(CHAIN, 4, jump_first=jump_first)
    for z in SEEN:
        modes, _ = one.update(one.predict(modes, TRANSITIONS), z, SENSOR)
        assert modes.mixture.weight.shape[-1] <= 4
    _, probability, mean, cov = enumerated(3, jump_first)
    np.testing.assert_allclose(modes.probability, probability, atol=5e-3)
    np.testing.assert_allclose(modes.moments[0], mean, atol=0.01 * np.sqrt(cov.max()))
    np.testing.assert_allclose(modes.moments[1], cov, atol=0.01 * cov.max())


def test_range_and_its_rate_against_a_million_samples():
    """Ahmed 5.4 with one platform: mode probabilities and mean by brute importance sampling over modes and noise."""
    rng, steps, count = np.random.default_rng(5), 3, 1_000_000
    sensor = RangeRangeRateSensor(LAYOUT, 20.0, 1.0, (0.0, -10e3))
    mean, cov = np.array([5e3, 100.0, 0.0, 375.0]), np.diag([500.0, 500.0, 100.0, 100.0])
    truth, zs = mean, []
    for _ in range(steps):
        truth = TRANSITIONS[1].advance(truth)
        zs.append(sensor.observe(truth) + [10.0, 0.5])
    x = mean + rng.normal(size=(count, 4)) * np.sqrt(np.diag(cov))
    mode, log = rng.choice(3, count, p=START), np.zeros(count)
    for z in zs:
        for m, transition in enumerate(TRANSITIONS):
            at = mode == m
            x[at] = transition.advance(x[at]) + rng.normal(size=(at.sum(), 4)) @ transition.noise_factor(x[at]).T
        mode = (rng.random(count)[:, None] > np.cumsum(CHAIN[mode], 1)).sum(1)
        log -= 0.5 * ((z - sensor.observe(x)) ** 2 / np.diag(sensor.noise)).sum(1)
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    assert 1 / (weight**2).sum() > 1000
    modes = MixtureModes(START, Mixture(np.ones((3, 1)), np.tile(mean, (3, 1, 1)), np.tile(cov, (3, 1, 1, 1))))
    one = GaussianSumModes(CHAIN, 12)
    for z in zs:
        modes, _ = one.update(one.predict(modes, TRANSITIONS), z, sensor)
    wanted = weight @ x
    spread = (weight[:, None] * (x - wanted)).T @ (x - wanted)
    np.testing.assert_allclose(modes.probability, [weight[mode == m].sum() for m in range(3)], atol=0.03)
    assert (np.abs(modes.moments[0] - wanted) < 0.1 * np.sqrt(np.diag(spread))).all()
    np.testing.assert_allclose(np.diag(modes.moments[1]), np.diag(spread), rtol=0.1)


def test_modes_are_recognised():
    """A target that turns for 30 steps is seen to turn, and tracked better than by a straight filter."""
    rng, runs = np.random.default_rng(0), 40
    truth = np.tile([0.0, 0.0, 20.0, 0.0], (runs, 1))
    modes = Modes.start(START, truth, np.tile(COV, (runs, 1, 1)))
    straight, alone = truth, np.tile(COV, (runs, 1, 1))
    errors = [[], []]
    for _ in range(30):
        truth = TRANSITIONS[1].advance(truth) + rng.normal(size=(runs, 4)) @ TRANSITIONS[1].noise_factor(truth).T
        z = truth[:, :2] + 2.0 * rng.normal(size=(runs, 2))
        modes, _ = IMM.update(IMM.predict(modes, TRANSITIONS), z, SENSOR)
        straight, alone = kalman.predict(straight, alone, *MOTIONS[0].matrices(1.0))
        straight, alone, _ = kalman.update(straight, alone, z, SENSOR.matrix, SENSOR.noise)
        for kept, mean in zip(errors, (modes.moments[0], straight), strict=True):
            kept.append(((mean - truth)[:, :2] ** 2).sum(1).mean())
    assert (modes.probability.argmax(-1) == 1).mean() > 0.9
    assert np.sqrt(np.mean(errors[0][5:])) < 0.8 * np.sqrt(np.mean(errors[1][5:]))


@pytest.mark.parametrize("lead", [(), (1,), (3, 2), (0,)])
@pytest.mark.parametrize("jump_first", [True, False])
def test_batch_equals_loop(lead, jump_first):
    rng, sensor = np.random.default_rng(1), RangeRangeRateSensor(LAYOUT, 5.0, 1.0, (-30.0, 4.0))
    mean, cov = MEAN + rng.normal(size=(*lead, 4)), np.broadcast_to(COV, (*lead, 4, 4))
    start, z = Modes.start(rng.dirichlet(np.ones(3), lead), mean, cov), rng.normal(size=(*lead, 2)) + [45.0, 5.0]
    imm = InteractingMultipleModel(CHAIN, jump_first)
    whole, learned = imm.update(imm.predict(start, TRANSITIONS), z, sensor)
    assert learned.log_likelihood.shape == lead
    for i in np.ndindex(lead):
        one = Modes(start.probability[i], start.mean[i], start.cov[i])
        alone, single = imm.update(imm.predict(one, TRANSITIONS), z[i], sensor)
        np.testing.assert_allclose(whole.probability[i], alone.probability, rtol=1e-11)
        np.testing.assert_allclose(whole.mean[i], alone.mean, rtol=1e-11)
        np.testing.assert_allclose(whole.cov[i], alone.cov, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(learned.log_likelihood[i], single.log_likelihood, rtol=1e-11)


def test_modes_that_cannot_be_reached_are_harmless():
    modes = Modes.start(np.array([1.0, 0.0, 0.0]), MEAN, COV)
    chain = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.5, 0.5, 0.0]])
    imm = InteractingMultipleModel(chain)
    modes, learned = imm.update(imm.predict(modes, TRANSITIONS), SEEN[0], SENSOR)
    np.testing.assert_array_equal(modes.probability, [1.0, 0.0, 0.0])
    assert np.isfinite(learned.log_likelihood)
    assert np.isfinite(modes.cov).all()


@pytest.mark.parametrize(
    ("chain", "message"),
    [
        (np.eye(2), r"of 3 modes must have shape \(3, 3\). Got \(2, 2\)"),
        (np.ones((3, 3)) / 2, "must be non-negative and sum to 1"),
    ],
)
def test_malformed_chains_are_refused(chain, message):
    with pytest.raises(ValueError, match=message):
        InteractingMultipleModel(chain).predict(Modes.start(START, MEAN, COV), TRANSITIONS)
