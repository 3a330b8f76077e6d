"""Split covariance intersection between its limits, against scipy, and what it says of the part left independent."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rules.examples import covariances, joint_covariances, rotated
from scipy.optimize import minimize

from track_fusion.linalg import Array
from track_fusion.rules import FusedTracks, SourceTracks, get_rule
from track_fusion.rules.split_covariance_intersection import RULE

CRITERIA = pytest.mark.parametrize("criterion", ["det", "trace"])
COUNTS = pytest.mark.parametrize("count", [2, 3, 5])


def fuse(mean: Array, cov: Array, alone: Array, **params: Any) -> FusedTracks:
    return RULE(SourceTracks(mean, cov, extras={"independent_cov": alone}), RULE.params(**params))


def drawn(rng: np.random.Generator, batch: int, count: int, rank: int = 2) -> tuple[Array, Array, Array]:
    """Tracks of four axes whose independent parts have this rank and at most 95 % of the covariance."""
    mean, cov = rng.normal(size=(batch, count, 4)), covariances(rng, batch, count)
    root = rng.normal(size=(batch, count, 4, rank))
    part = root @ np.swapaxes(root, -1, -2)
    largest = np.linalg.eigvals(np.linalg.solve(cov, part)).real.max(-1)
    return mean, cov, part * (rng.uniform(0.1, 0.95, largest.shape) / largest)[..., None, None]


@CRITERIA
@COUNTS
def test_limits(criterion: str, count: int) -> None:
    """No independent part: covariance intersection. Nothing else: naive fusion."""
    rng = np.random.default_rng(1)
    mean, cov, _ = drawn(rng, 30, count)
    rule = get_rule("covariance_intersection")
    crossed = rule(SourceTracks(mean, cov), rule.params(criterion=criterion))  # type: ignore[call-arg]
    none, whole = fuse(mean, cov, 0.0 * cov, criterion=criterion), fuse(mean, cov, cov, criterion=criterion)
    np.testing.assert_allclose(none.cov, crossed.cov, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(none.mean, crossed.mean, atol=1e-7)
    np.testing.assert_allclose(none.info["independent_cov"], 0.0, atol=1e-12)
    naive = get_rule("naive")(SourceTracks(mean, cov))
    np.testing.assert_allclose(whole.cov, naive.cov, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(whole.mean, naive.mean, atol=1e-9)
    np.testing.assert_allclose(whole.info["independent_cov"], naive.cov, rtol=1e-9, atol=1e-10)


@CRITERIA
@COUNTS
@pytest.mark.parametrize("rank", [1, 4])
def test_weights_against_slsqp(criterion: str, count: int, rank: int) -> None:
    rng = np.random.default_rng(2)
    mean, cov, alone = drawn(rng, 8, count, rank)
    fused = fuse(mean, cov, alone, criterion=criterion)
    assert fused.weights is not None
    assert np.all(fused.info["converged"])
    for p, part, weights, claim in zip(cov, alone, fused.weights, fused.cov, strict=True):

        def cost(w: Array, p: Array = p, part: Array = part) -> tuple[float, Array]:
            share = np.maximum(w, 1e-12)[:, None, None]
            whole = np.linalg.inv(np.linalg.inv((p - part) / share + part).sum(0))
            return float(np.linalg.slogdet(whole)[1] if criterion == "det" else np.log(np.trace(whole))), whole

        found = minimize(
            lambda w, cost=cost: cost(w)[0], np.full(count, 1.0 / count), method="SLSQP", bounds=[(1e-9, 1.0)] * count,
            constraints={"type": "eq", "fun": lambda w: w.sum() - 1.0}, options={"ftol": 1e-13, "maxiter": 300},
        )  # fmt: skip
        assert cost(weights)[0] <= found.fun + 1e-9
        assert cost(weights)[0] >= found.fun - 1e-6
        np.testing.assert_allclose(claim, cost(weights)[1], rtol=1e-6, atol=1e-8)


def test_a_known_independent_part_makes_the_claim_smaller() -> None:
    rng = np.random.default_rng(3)
    mean, cov, alone = drawn(rng, 50, 2, 4)
    given = {"criterion": "given", "weights": (0.4, 0.6)}
    rule = get_rule("covariance_intersection")
    crossed = rule(SourceTracks(mean, cov), rule.params(**given))
    assert np.linalg.eigvalsh(crossed.cov - fuse(mean, cov, alone, **given).cov).min() > 1e-6


def test_the_independent_part_that_is_handed_on_is_right() -> None:
    """The share of the error that comes from the independent parts; the other part bounds the rest."""
    rng = np.random.default_rng(4)
    _, cov, alone = drawn(rng, 1, 2, 4)
    given = {"criterion": "given", "weights": (0.3, 0.7)}
    probes = np.concatenate([np.eye(8), np.zeros((1, 8))]).reshape(9, 2, 4)
    repeat = [np.broadcast_to(a[0], (9, 2, 4, 4)) for a in (cov, alone)]
    fused = fuse(probes, *repeat, **given)
    gain, part = fused.mean[:8].T, fused.info["independent_cov"][8]
    wanted = sum(gain[:, 4 * k : 4 * k + 4] @ alone[0, k] @ gain[:, 4 * k : 4 * k + 4].T for k in range(2))
    np.testing.assert_allclose(part, wanted, atol=1e-10)
    shared = joint_covariances(rng, (cov - alone)[0], 500)
    rest = np.linalg.eigvalsh((fused.cov[8] - part) - gain @ shared @ gain.T)
    assert rest.min() > -1e-9
    assert rest[:, 0].min() < 0.1 * np.linalg.eigvalsh(part).max()  # and comes near


@pytest.mark.parametrize("count", [2, 3])
def test_complementary_vague_axes(count: int) -> None:
    """The sharp axes of tracks that are each vague elsewhere survive; numbers far apart do no harm."""
    axes = np.array([[1.0, 1.0, 1e12, 1e12], [1e12, 1e12, 1.0, 1.0], [1e12, 1.0, 1.0, 1e12]])[:count]
    cov = np.stack([rotated(np.random.default_rng(5), d) for d in axes])
    fused = fuse(np.zeros((count, 4)), cov, 0.5 * cov)
    assert fused.info["converged"]
    values = np.linalg.eigvalsh(fused.cov)
    assert values.max() < 2.0  # covariance intersection at halves would say 2
    assert values.min() > 0.3


def test_malformed_independent_parts() -> None:
    mean, cov = np.zeros((2, 2)), np.stack([np.eye(2), 4.0 * np.eye(2)])
    with pytest.raises(
        ValueError, match=r"The 'independent_cov' of source tracks must have shape \(2, 2, 2\). Got \(2, 2\)."
    ):
        fuse(mean, cov, np.eye(2))
    with pytest.raises(ValueError, match="The 'independent_cov' of source tracks must not exceed 'cov'."):
        fuse(mean, cov, 1.5 * cov)
    with pytest.raises(ValueError, match="The 'independent_cov' of source tracks must be positive semi-definite."):
        fuse(mean, cov, -0.1 * cov)
    with pytest.raises(
        ValueError, match="The rule 'split_covariance_intersection' needs 'independent_cov' beside the tracks."
    ):
        RULE(SourceTracks(mean, cov))
