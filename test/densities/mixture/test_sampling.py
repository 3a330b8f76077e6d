"""Algorithms 1 to 5 of Ahmed, each by itself: against quadrature, within their Monte Carlo error, seeded."""

from __future__ import annotations

import numpy as np
import pytest
from densities.mixture.examples import COMMON, FIRST, SECOND, draw, mixand_moments
from scipy import integrate
from scipy.stats import norm

from track_fusion.densities.mixture.exponent import optimise_omega
from track_fusion.densities.mixture.mixture import Mixture, log_pdf, moments, sample
from track_fusion.densities.mixture.proposals import (
    Proposal,
    bounded,
    direct_local_sampling,
    heavy_tail,
    indirect_global_sampling,
    inflated_naive,
    laplace_proposal,
    laplace_proposals,
    prune_mixands,
)
from track_fusion.densities.mixture.quotient import exact_bound, exact_quotient, laplace, wep_quotient
from track_fusion.densities.mixture.sampling import (
    Weighted,
    floored,
    single_shot_em,
    weighted_em,
)
from track_fusion.densities.on_grid import grid, moments_on_grid
from track_fusion.linalg import Array

POINTS = grid(np.array([-40.0]), np.array([40.0]), 4000)


def _log(mixture: Mixture) -> Array:
    return log_pdf(mixture, POINTS)


def _integral(log_density: Array) -> float:
    return float(np.exp(log_density).sum() * 80.0 / 4000)


# Algorithm 2.


def test_weighted_em_recovers_a_mixture_from_weighted_samples() -> None:
    truth = Mixture(
        np.array([0.3, 0.7]), np.array([[-4.0, 0.0], [3.0, 1.0]]), np.stack([np.eye(2), np.diag([1.0, 4.0])])
    )
    wide = Mixture(np.ones(1), np.zeros((1, 2)), 20.0 * np.eye(2)[None])
    points = sample(wide, np.random.default_rng(0), 8000).points
    learned = weighted_em(Weighted(points, log_pdf(truth, points) - log_pdf(wide, points)), 2, np.random.default_rng(1))
    assert learned.converged
    order = np.argsort(learned.mixture.weight)
    np.testing.assert_allclose(learned.mixture.weight[order], truth.weight, atol=0.03)
    np.testing.assert_allclose(learned.mixture.mean[order], truth.mean, atol=0.15)
    np.testing.assert_allclose(learned.mixture.cov[order], truth.cov, atol=0.3)


def test_weighted_em_does_not_depend_on_the_batch() -> None:
    rng = np.random.default_rng(2)
    mixture = draw(rng, 3, count=3)
    points = sample(mixture, rng, 300).points
    whole = weighted_em(Weighted(points, np.zeros((3, 300))), 3, np.random.default_rng(0))
    alone = weighted_em(Weighted(points[1], np.zeros(300)), 3, np.random.default_rng(0))
    np.testing.assert_allclose(alone.mixture.mean, whole.mixture.mean[1], rtol=1e-12)
    assert alone.iterations == whole.iterations[1]


# Algorithm 3.


def test_single_shot_em_keeps_the_moments_of_the_samples() -> None:
    quotient = exact_quotient(FIRST, SECOND, COMMON)
    proposal = laplace_proposal(laplace(quotient))
    drawn = indirect_global_sampling(quotient, proposal, np.random.default_rng(0), 500, floor=0.0)
    for got, wanted in zip(moments(drawn.mixture), drawn.samples.moments(), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-10)


def test_single_shot_em_survives_mixands_without_samples() -> None:
    quotient = exact_quotient(FIRST, SECOND, COMMON)
    far = quotient.numerator._replace(mean=quotient.numerator.mean + np.array([[0.0], [0.0], [0.0], [1e4]]))
    learned = single_shot_em(Weighted(np.linspace(-3, 3, 50)[:, None], np.zeros(50)), far)
    assert learned.weight[3] == 0.0
    np.testing.assert_allclose(learned.cov[3], far.cov[3])
    assert np.isfinite(learned.mean).all()


# Algorithms 4 and 5.


def test_igs_and_its_proposal_against_quadrature() -> None:
    quotient = exact_quotient(FIRST, SECOND, COMMON)
    wanted = [mixand_moments(quotient, z) for z in range(4)]
    found = indirect_global_sampling(quotient, laplace_proposal(laplace(quotient)), np.random.default_rng(0), 40000)
    total = sum(w[0] for w in wanted)
    assert found.samples.log_eta == pytest.approx(np.log(total), abs=0.02)
    for z, (mass, mean, variance) in enumerate(wanted):
        assert found.mixture.weight[z] == pytest.approx(mass / total, abs=0.01)
        assert found.mixture.mean[z, 0] == pytest.approx(mean, abs=0.1 * np.sqrt(variance))
        assert found.mixture.cov[z, 0, 0] == pytest.approx(variance, rel=0.1)


def _proposals(kind: str) -> tuple[Proposal, object]:
    quotient = exact_quotient(FIRST, SECOND, COMMON)
    if kind == "ingis":
        return inflated_naive(quotient, FIRST, SECOND), quotient
    found = laplace(quotient)
    if kind == "lagis":
        return laplace_proposals(found), quotient
    bound = exact_bound(quotient, COMMON)
    return bounded(found, bound.mean, bound.cov) if kind == "bounded" else heavy_tail(found, bound.cov), quotient


@pytest.mark.parametrize("kind", ["ingis", "lagis", "heavy_tail", "bounded"])
def test_dls_against_quadrature(kind: str) -> None:
    proposal, quotient = _proposals(kind)
    found = direct_local_sampling(quotient, proposal, np.random.default_rng(0), 20000)  # type: ignore[arg-type]
    wanted = [mixand_moments(quotient, z) for z in range(4)]  # type: ignore[arg-type]
    total = sum(w[0] for w in wanted)
    assert found.log_eta == pytest.approx(np.log(total), abs=0.02)
    assert (found.ess > 0.3 * 20000).all()
    for z, (mass, mean, variance) in enumerate(wanted):
        assert found.mixture.weight[z] == pytest.approx(mass / total, abs=0.01)
        assert found.mixture.mean[z, 0] == pytest.approx(mean, abs=0.05 * np.sqrt(variance))
        assert found.mixture.cov[z, 0, 0] == pytest.approx(variance, rel=0.08)


def test_dls_of_a_weighted_exponential_product_against_quadrature() -> None:
    quotient = wep_quotient(FIRST, SECOND, np.array(0.35))
    found = direct_local_sampling(quotient, inflated_naive(quotient, FIRST, SECOND), np.random.default_rng(0), 20000)
    a, b = _log(FIRST), _log(SECOND)
    assert found.log_eta == pytest.approx(np.log(_integral(0.35 * a + 0.65 * b)), abs=0.02)
    mean, cov = moments_on_grid(0.35 * log_pdf(FIRST, POINTS) + 0.65 * log_pdf(SECOND, POINTS), POINTS)
    got = moments(found.mixture)
    assert got[0][0] == pytest.approx(mean[0], abs=0.05)
    assert got[1][0, 0] == pytest.approx(cov[0, 0], rel=0.05)


def test_the_generator_alone_decides_on_the_samples() -> None:
    quotient = exact_quotient(FIRST, SECOND, COMMON)
    proposal = inflated_naive(quotient, FIRST, SECOND)
    results = [direct_local_sampling(quotient, proposal, np.random.default_rng(s), 50).mixture.mean for s in (1, 1, 2)]
    np.testing.assert_array_equal(results[0], results[1])
    assert np.abs(results[0] - results[2]).max() > 1e-3


def test_inflated_naive_takes_the_largest_determinant() -> None:
    first, second = draw(np.random.default_rng(3), count=2), draw(np.random.default_rng(4), count=2)
    quotient = wep_quotient(first, second, np.array(0.5))
    for variance in (0.0, 2.0, 1e3):
        proposal = inflated_naive(quotient, first, second, variance)
        for z, (v, r) in enumerate(np.ndindex(2, 2)):
            candidates = [first.cov[v], second.cov[r], variance * np.eye(2)]
            wanted = max(candidates, key=lambda c: float(np.linalg.det(c)))
            np.testing.assert_array_equal(proposal.cov[z], wanted)


def test_heavy_tails_reach_between_two_and_eight() -> None:
    found = laplace(exact_quotient(FIRST, SECOND, COMMON))
    for factor, top in ((1.0, 2.0), (5.0, 5.0), (100.0, 8.0)):
        scale = heavy_tail(found, factor * found.cov).scale
        np.testing.assert_allclose(scale[:, 0], 1.0)
        np.testing.assert_allclose(scale[:, -1], top)
        np.testing.assert_allclose(scale[:, 1:] / scale[:, :-1], top**0.25)


def test_no_weight_of_a_bounded_proposal_exceeds_twice_the_bound() -> None:
    """By quadrature it is a density, and everywhere at least half of the Gaussian above the mixand."""
    quotient = exact_quotient(FIRST, SECOND, COMMON)
    bound = exact_bound(quotient, COMMON)
    proposal = bounded(laplace(quotient), bound.mean, bound.cov)
    points = np.broadcast_to(POINTS, (4, *POINTS.shape))
    log_drawn = proposal.log_pdf(points)
    np.testing.assert_allclose(np.exp(log_drawn).sum(-1) * 80.0 / 4000, 1.0, rtol=1e-6)
    for z in range(4):
        mixand = norm.logpdf(POINTS[:, 0], quotient.numerator.mean[z, 0], np.sqrt(quotient.numerator.cov[z, 0, 0]))
        log_weight = quotient.numerator.log_weight[z] + mixand - _log(COMMON) - log_drawn[z]
        assert log_weight.max() <= np.log(2.0) + bound.log_weight[z] + 1e-9


def test_every_other_sample_of_a_bounded_proposal_is_of_the_gaussian_above() -> None:
    quotient = exact_quotient(FIRST, SECOND, COMMON)
    found, bound = laplace(quotient), exact_bound(quotient, COMMON)
    points = bounded(found, bound.mean, bound.cov).drawn(np.random.default_rng(0).normal(size=(4, 40000, 1)))
    above = points[:, ::2, 0]
    np.testing.assert_allclose(above.mean(-1), bound.mean[:, 0], atol=0.03 * np.sqrt(bound.cov.max()))
    np.testing.assert_allclose(above.var(-1), bound.cov[:, 0, 0], rtol=0.04)


def test_pruning_drops_only_what_is_negligible() -> None:
    rng = np.random.default_rng(5)
    first, second, wide = draw(rng, count=5, spread=8.0), draw(rng, count=5, spread=8.0), draw(rng, count=3)
    common = Mixture(wide.weight, wide.mean, wide.cov + 200 * np.eye(2))
    quotient = exact_quotient(first, second, common)
    found, bound = laplace(quotient), exact_bound(quotient, common)
    kept = prune_mixands(quotient, bound.log_weight, found.log_moment, 14.0)
    assert 1 <= kept.keep.sum() < 25
    true = np.exp(found.log_moment - found.log_moment.max())
    dropped = np.setdiff1d(np.arange(25), kept.order[kept.keep])
    assert true[dropped].sum() < 25 * np.exp(-14.0)
    assert true[dropped].sum() / true.sum() <= kept.share < 1e-4


def test_floored_covariances() -> None:
    rng = np.random.default_rng(6)
    least = draw(rng, 8, count=1).cov[:, 0]
    cov = least @ np.diag([0.01, 3.0])
    cov = 0.5 * (cov + np.swapaxes(cov, 1, 2)) + 0.2 * least
    found = floored(cov, least, 0.3)
    white = np.linalg.inv(np.linalg.cholesky(least))
    values = np.linalg.eigvalsh(white @ found @ np.swapaxes(white, 1, 2))
    assert (values >= 0.3 - 1e-12).all()
    fine = np.linalg.eigvalsh(white @ cov @ np.swapaxes(white, 1, 2)).min(1) >= 0.3
    np.testing.assert_array_equal(found[fine], cov[fine])


def test_disjoint_densities_show_in_the_normaliser_not_in_the_ess() -> None:
    far = Mixture(SECOND.weight, SECOND.mean + 200.0, SECOND.cov)
    found = optimise_omega(FIRST, far, np.random.default_rng(0), 500, omega=np.array(0.5))
    assert found.samples.ess > 100
    a = float(found.samples.log_eta)
    x = np.linspace(60.0, 160.0, 20001)[:, None]
    logs = 0.5 * (log_pdf(FIRST, x) + log_pdf(far, x))
    wanted = logs.max() + np.log(integrate.trapezoid(np.exp(logs - logs.max()), x[:, 0]))
    assert a == pytest.approx(wanted, abs=0.2)
    assert a < -1000
