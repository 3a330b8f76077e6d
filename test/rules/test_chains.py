"""The fusion chains (13) and (19) of Li 2022, in trace, and in the Loewner order where ERRATA.md says so."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rules.examples import covariances

from track_fusion.linalg import Array
from track_fusion.rules import SourceTracks, get_rule

COUNT = 300


def fused(key: str, mean: Array, cov: Array, **params: Any) -> Array:
    rule = get_rule(key)
    return rule(SourceTracks(mean, cov), rule.params(**params)).cov


def below(first: Array, second: Array) -> Array:
    """Lowest eigenvalue of second - first, (...): not negative where first <= second."""
    return np.asarray(np.linalg.eigvalsh(second - first)[..., 0])


def trace(cov: Array) -> Array:
    return np.asarray(np.trace(cov, axis1=-2, axis2=-1))


@pytest.fixture(params=[0.0, 1.0, 20.0], ids=lambda d: f"distance{d:g}")
def tracks(request: pytest.FixtureRequest) -> tuple[Array, Array]:
    rng = np.random.default_rng(1)
    return request.param * rng.normal(size=(COUNT, 2, 4)), covariances(rng, COUNT, 2)


def test_chain_13_in_trace(tracks: tuple[Array, Array]) -> None:
    """Naive < min P <= CU min <= AA <= CU max."""
    mean, cov = tracks
    chain = [
        trace(fused("naive", mean, cov)), trace(cov).min(1),
        trace(fused("covariance_union", mean, cov, bound="min_trace")),
        trace(fused("arithmetic_average", mean, cov, criterion="uniform")),
        trace(fused("covariance_union", mean, cov, bound="max_trace")),
        trace(fused("covariance_union", mean, cov, criterion="trace")),
    ]  # fmt: skip
    for lower, upper in zip(chain[:-1], chain[1:], strict=True):
        assert (lower <= upper * (1.0 + 1e-12)).all()
    assert (chain[0] < chain[1]).all()


def test_chain_19_in_trace(tracks: tuple[Array, Array]) -> None:
    """Naive < ICI <= CI <= AA, FFCC, each with weights of its own by the trace."""
    mean, cov = tracks
    chain = [
        trace(fused("naive", mean, cov)), trace(fused("inverse_covariance_intersection", mean, cov, criterion="trace")),
        trace(fused("covariance_intersection", mean, cov, criterion="trace")),
    ]  # fmt: skip
    average = trace(fused("arithmetic_average", mean, cov))
    tolerant = trace(fused("fault_tolerant_covariance_intersection", mean, cov, criterion="trace"))
    assert (chain[0] < chain[1]).all()
    assert (chain[1] <= chain[2] * (1.0 + 1e-9)).all()
    assert (chain[2] <= average * (1.0 + 1e-9)).all()
    assert (chain[2] < tolerant).all()


def test_what_holds_in_the_loewner_order(tracks: tuple[Array, Array]) -> None:
    mean, cov = tracks
    naive = fused("naive", mean, cov)
    assert (below(naive[:, None], cov) > 0).all()  # Naive < P_i, whichever is smallest
    rng = np.random.default_rng(2)
    for omega in rng.uniform(0.05, 0.95, 5):
        given = {"criterion": "given", "weights": (omega, 1.0 - omega)}
        mirrored = {"criterion": "given", "weights": (1.0 - omega, omega)}
        inverse = fused("inverse_covariance_intersection", mean, cov, **mirrored)
        crossed = fused("covariance_intersection", mean, cov, **given)
        average = fused("arithmetic_average", mean, cov, **given)
        union = fused("covariance_union", mean, cov, weights=(omega, 1.0 - omega))
        assert (below(naive, inverse) > 0).all()
        assert (below(inverse, crossed) > -1e-9).all()
        assert (below(crossed, average) > -1e-9).all()
        assert (below(average, union) > -1e-9).all()


def test_what_does_not_hold_in_the_loewner_order(tracks: tuple[Array, Array]) -> None:
    """The rest of the chains: P1 and CU min, AA and the side of largest trace, ICI and CI at weights of their own."""
    mean, cov = tracks
    average = fused("arithmetic_average", mean, cov, criterion="uniform")
    assert (below(fused("covariance_union", mean, cov, bound="min_trace"), average) < -1e-6).mean() > 0.5
    assert (below(average, fused("covariance_union", mean, cov, bound="max_trace")) < -1e-6).mean() > 0.5
    inverse = fused("inverse_covariance_intersection", mean, cov)
    assert (below(inverse, fused("covariance_intersection", mean, cov)) < -1e-9).any()


def test_lemma_4_averages_of_independent_errors() -> None:
    """Sum of w_i (MSE_i - MSE of the average) > 0, (23); errors that are all the same break it."""
    rng = np.random.default_rng(3)
    own, weights, runs = covariances(rng, 3), (0.5, 0.2, 0.3), 4000
    rule = get_rule("arithmetic_average")
    params = rule.params(criterion="given", weights=weights)  # type: ignore[call-arg]
    noise = rng.normal(size=(runs, 3, 4))
    for independent in (True, False):
        draws = noise if independent else np.repeat(noise[:, :1], 3, 1)
        cov = own if independent else np.repeat(own[:1], 3, 0)
        errors = np.einsum("kij,bkj->bki", np.linalg.cholesky(cov), draws)
        mean = rule(SourceTracks(errors, np.broadcast_to(cov, (runs, 3, 4, 4))), params).mean
        single = np.einsum("k,bki,bkj->ij", weights, errors, errors) / runs
        gain = np.linalg.eigvalsh(single - mean.T @ mean / runs)
        if independent:
            assert gain.min() > 0.1 * np.linalg.eigvalsh(single).min()
        else:
            np.testing.assert_allclose(gain, 0.0, atol=1e-9)
