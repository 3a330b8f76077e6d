"""All rules on mixtures, by every method: units, wild covariances, ten sources, disjoint mixtures, refusals."""

from __future__ import annotations

import dataclasses
from typing import Any

import mpmath
import numpy as np
import pytest
from densities.mixture.examples import draw
from oracles.mixtures import by_scipy
from rules.examples import rotated
from rules.mixtures import as_tracks
from scipy import integrate

from track_fusion.densities.mixture.mixture import Mixture
from track_fusion.linalg import Array
from track_fusion.params import from_dict
from track_fusion.rules import FusedTracks, SourceTracks, get_rule

SAMPLED_EXACT = [{"method": "dls"}, {"proposal": "ingis"}, {"proposal": "lagis"}, {"method": "igs"}]
CLOSED_EXACT = [{"method": "mmgd"}, {"method": "laplace"}]
WEP = [{"method": m} for m in ("dls", "igs", "is_wem", "foci", "pcci")]
WEP += [{"proposal": "ingis"}, {"method": "igs", "omega_proposal": "first_order"}]
NAIVE = {"method": "naive_bayes"}
CASES: list[tuple[str, dict[str, Any]]] = [
    *(("mixture_exact", values) for values in (*SAMPLED_EXACT, *CLOSED_EXACT, NAIVE)),
    *(("mixture_wep", values) for values in (*WEP, NAIVE)),
    *((key, {}) for key in ("mixture_average", "mixture_geometric", "mixture_hybrid")),
]
EVERY_METHOD = pytest.mark.parametrize(
    ("key", "values"), CASES, ids=[f"{key}-{'-'.join(values.values())}" for key, values in CASES]
)


def run(key: str, tracks: SourceTracks, values: dict[str, Any]) -> FusedTracks:
    rule = get_rule(key)
    return rule(tracks, from_dict(rule.params, values))


def vague(parts: Mixture, factor: float = 3.0) -> SourceTracks:
    """Tracks (..., K, C) whose common information, of two components, is wider than all of their components."""
    cov, mean = factor * parts.cov.sum((-4, -3)), parts.mean.mean((-3, -2))
    weight = np.full((*mean.shape[:-1], 2), 0.5)
    common = Mixture(weight, np.stack([mean, mean], -2), np.stack([cov, 2.0 * cov], -3))
    return dataclasses.replace(as_tracks(parts), extras={"common": common})


def assert_sound(fused: FusedTracks) -> None:
    """Finite, and positive definite whatever the units of the axes."""
    assert np.isfinite(fused.mean).all()
    np.linalg.cholesky(fused.cov)
    assert fused.mixture is not None
    assert all(np.isfinite(array).all() for array in vars(fused.mixture).values())
    assert (fused.mixture.weight.sum(-1) > 0).all()


@EVERY_METHOD
@pytest.mark.parametrize(
    ("scale", "shift"),
    [([1e10] * 3, 0.0), ([1e-10] * 3, 0.0), ([1e10, 1.0, 1e-5], 0.0), ([1.0] * 3, 1e6)],
    ids=["large", "small", "mixed", "far"],
)
def test_units_and_origin_do_not_matter(key: str, values: dict[str, Any], scale: list[float], shift: float) -> None:
    """Scaling by axis keeps the Cholesky factors, and so the samples: the results agree to rounding."""
    parts, unit = draw(np.random.default_rng(0), 4, 2, n=3), np.array(scale)
    square = np.multiply.outer(unit, unit)
    there = run(key, vague(Mixture(parts.weight, parts.mean * unit + shift, parts.cov * square)), values)
    here = run(key, vague(parts), values)
    sigma = np.sqrt(np.diagonal(here.cov, axis1=-2, axis2=-1))
    assert (np.abs((there.mean - shift) / unit - here.mean) <= 1e-5 * sigma).all()
    assert (np.abs(there.cov / square - here.cov) <= 1e-5 * sigma[..., :, None] * sigma[..., None, :]).all()


@EVERY_METHOD
def test_wild_covariances(key: str, values: dict[str, Any]) -> None:
    """Condition numbers up to 1e13 in random orientations, each component vague where others are sharp."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        cov = [[rotated(rng, 10.0 ** rng.uniform(-6.5, 6.5, 3)) for _ in range(2)] for _ in range(2)]
        parts = Mixture(np.full((2, 2), 0.5), rng.normal(size=(2, 2, 3)), np.array(cov))
        assert_sound(run(key, vague(parts), values))


WEIGHTS = (0.4, 0.6)
GIVEN = {"criterion": "given", "weights": WEIGHTS}
#: rule, parameters, information of the two sources and of what they share that it counts
LINEAR = [
    ("mixture_wep", GIVEN, (*WEIGHTS, 0.0)),
    ("mixture_geometric", GIVEN, (*WEIGHTS, 0.0)),
    ("mixture_hybrid", GIVEN, (*WEIGHTS, 0.0)),
    ("mixture_exact", {}, (1.0, 1.0, -1.0)),
    ("mixture_exact", NAIVE, (1.0, 1.0, 0.0)),
    ("mixture_wep", NAIVE, (1.0, 1.0, 0.0)),
]


def _wild_pair(kind: str, rng: np.random.Generator) -> Array:
    if kind == "random":
        return np.array([rotated(rng, 10.0 ** rng.uniform(-6.5, 6.5, 3)) for _ in range(2)])
    basis = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    cov = np.array([basis * axes @ basis.T for axes in ([1e-6, 1e6, 1.0], [1e6, 1e-6, 1e-3])])
    return 0.5 * (cov + np.swapaxes(cov, -1, -2))


@pytest.mark.parametrize("kind", ["random", "complementary"])
@pytest.mark.parametrize(("key", "values", "counts"), LINEAR)
def test_one_component_against_mpmath(key: str, values: dict[str, Any], counts: tuple[float, ...], kind: str) -> None:
    """In units of the wanted covariance; a covariance of condition 1e13 itself is known to 1e-3 only."""
    worst = []
    for seed in range(15):
        rng = np.random.default_rng(seed)
        cov, mean = _wild_pair(kind, rng), rng.normal(size=(2, 3))
        common = mean.mean(0), 3.0 * cov.sum(0)
        extras = {"common": Mixture(np.ones(1), common[0][None], common[1][None])}
        fused = run(key, SourceTracks(mean, cov, extras=extras), values)
        with mpmath.workdps(80):
            infos = [mpmath.matrix(c.tolist()) ** -1 for c in (*cov, common[1])]
            means = [mpmath.matrix(m.tolist()) for m in (*mean, common[0])]
            zero = mpmath.zeros(3)
            wanted = sum((c * i for c, i in zip(counts, infos, strict=True)), zero) ** -1
            pulls = (c * (i * m) for c, i, m in zip(counts, infos, means, strict=True))
            white = mpmath.cholesky(wanted) ** -1
            gap = white * (mpmath.matrix(fused.mean.tolist()) - wanted * sum(pulls, mpmath.zeros(3, 1)))
            error = white * (mpmath.matrix(fused.cov.tolist()) - wanted) * white.T
            worst.append(float(max(abs(v) for v in (*error, *gap))))
    assert max(worst) < 2e-3
    assert np.median(worst) < 5e-5


@EVERY_METHOD
def test_ten_sources_of_mixtures(key: str, values: dict[str, Any]) -> None:
    small = values | {"max_components": 10}
    fused = run(key, vague(draw(np.random.default_rng(3), 2, 10, n=3), 1.0), small)
    assert_sound(fused)
    assert fused.mixture is not None
    assert fused.mixture.count <= 10


def test_ten_sources_of_one_component() -> None:
    parts = draw(np.random.default_rng(4), 5, 10, count=1, n=3)
    cov, mean = parts.cov[..., 0, :, :], parts.mean[..., 0, :]
    common = Mixture(np.ones((5, 1)), mean.mean(1)[:, None], 10.0 * cov.sum(1)[:, None])
    tracks = SourceTracks(mean, cov, extras={"common": common})
    info, shared = np.linalg.inv(cov), np.linalg.inv(common.cov[:, 0])
    pull = (info @ mean[..., None])[..., 0]
    shared_pull = (shared @ common.mean[:, 0, :, None])[..., 0]
    for key, share, times in (("mixture_exact", 1.0, 9.0), ("mixture_geometric", 0.1, 0.0), ("mixture_wep", 0.1, 0.0)):
        values = {"criterion": "given", "weights": (0.1,) * 10} if key == "mixture_wep" else {}
        fused = run(key, tracks, values)
        wanted = np.linalg.inv(share * info.sum(1) - times * shared)
        centre = (wanted @ (share * pull.sum(1) - times * shared_pull)[..., None])[..., 0]
        np.testing.assert_allclose(fused.cov, wanted, rtol=1e-9, err_msg=key)
        np.testing.assert_allclose(fused.mean, centre, rtol=1e-8, atol=1e-9, err_msg=key)


@pytest.mark.parametrize("values", [*SAMPLED_EXACT, *CLOSED_EXACT, NAIVE], ids=lambda v: "-".join(v.values()))
@pytest.mark.parametrize("width", [30.0, 1e7])
def test_exact_fusion_of_disjoint_mixtures(values: dict[str, Any], width: float) -> None:
    """A thousand standard deviations apart: the product lies midway, and log_eta says that there is next to nothing."""
    near = np.array([[[0.0], [1.0]], [[1000.0], [1002.0]]])
    parts = Mixture(np.full((2, 2), 0.5), near, np.ones((2, 2, 1, 1)))
    common = Mixture(np.full(2, 0.5), np.array([[0.0], [500.0]]), np.full((2, 1, 1), width))
    fused = run("mixture_exact", dataclasses.replace(as_tracks(parts), extras={"common": common}), values)
    assert fused.mean[0] == pytest.approx(500.5, abs=0.15)  # between the two nearest components
    assert fused.cov[0, 0] == pytest.approx(0.5, rel=0.25)
    assert fused.info["log_eta"] == pytest.approx(-249_500.0, rel=1e-4)
    assert fused.info["converged"]


@pytest.mark.parametrize("values", [*SAMPLED_EXACT, *CLOSED_EXACT, NAIVE], ids=lambda v: "-".join(v.values()))
def test_log_eta_is_the_integral_by_quadrature(values: dict[str, Any]) -> None:
    parts = Mixture(np.full((2, 2), 0.5), np.array([[[0.0], [3.0]], [[1.0], [4.0]]]), np.full((2, 2, 1, 1), 2.0))
    common = Mixture(np.ones(1), np.array([[1.5]]), np.full((1, 1, 1), 40.0))  # one: every method is right
    fused = run("mixture_exact", dataclasses.replace(as_tracks(parts), extras={"common": common}), values)

    def density(x: float) -> float:
        logs = [float(by_scipy(m, np.array([[x]]))) for m in (parts.at(0), parts.at(1), common)]
        return float(np.exp(logs[0] + logs[1] - (0.0 if values == NAIVE else logs[2])))

    wanted = np.log(integrate.quad(density, -30.0, 30.0, points=[1.0, 3.0])[0])
    assert float(fused.info["log_eta"]) == pytest.approx(wanted, abs=0.03)


@EVERY_METHOD
def test_components_without_weight_change_nothing(key: str, values: dict[str, Any]) -> None:
    """In a batch a Gaussian track is padded to the components of its neighbours: it is still fused as a Gaussian."""
    one = draw(np.random.default_rng(5), 3, 2, count=1)
    padding = Mixture(0.0 * one.weight, one.mean + 50.0, one.cov)
    padded = Mixture(*(np.concatenate(p, 2) for p in zip(vars(one).values(), vars(padding).values(), strict=True)))
    wide = vague(one).extras["common"]
    common = Mixture(np.tile([1.0, 0.0], (3, 1)), wide.mean, wide.cov)
    single = Mixture(np.ones((3, 1)), wide.mean[:, :1], wide.cov[:, :1])
    alone = run(key, dataclasses.replace(as_tracks(one), extras={"common": single}), values)
    among = run(key, dataclasses.replace(as_tracks(padded), extras={"common": common}), values)
    np.testing.assert_allclose(among.mean, alone.mean, rtol=1e-12)
    np.testing.assert_allclose(among.cov, alone.cov, rtol=1e-12)


@pytest.mark.parametrize("key", ["mixture_exact", "mixture_wep"])
def test_gaussians_and_mixtures_in_one_batch_are_fused_each_in_its_way(key: str) -> None:
    parts = draw(np.random.default_rng(6), 2, 2, count=2)
    parts.weight[0] = [1.0, 0.0]
    tracks = vague(parts)
    tracks.extras["common"].weight[0] = [1.0, 0.0]
    whole = run(key, tracks, {})
    for row in range(2):
        common = tracks.extras["common"].at(row)
        alone = run(key, dataclasses.replace(as_tracks(parts.at(row)), extras={"common": common}), {})
        np.testing.assert_allclose(whole.mean[row], alone.mean, rtol=1e-9)
        np.testing.assert_allclose(whole.info["ess"][row], alone.info["ess"], rtol=1e-9)
    assert whole.info["ess"][0] == 1.0
    assert whole.info["ess"][1] < 1.0


def test_what_is_known_without_samples_says_so() -> None:
    """Equal sources, and a source that says nothing new, come back whole: all samples count, nothing is lost."""
    parts = draw(np.random.default_rng(7), 2)
    silent = dataclasses.replace(as_tracks(parts), extras={"common": parts.at(1)})
    twice = as_tracks(Mixture(*(np.stack([a[0], a[0]]) for a in vars(parts).values())))
    for fused in (run("mixture_exact", silent, {}), run("mixture_wep", twice, {})):
        np.testing.assert_allclose(fused.mean, as_tracks(parts).mean[0], rtol=1e-12)
        assert (fused.info["ess"], fused.info["log_eta"], fused.info["pruned"]) == (1.0, 0.0, 0.0)


def test_samples_that_miss_the_sources_are_refused() -> None:
    parts = Mixture(np.full((2, 2), 0.5), np.array([[[0.0], [1.0]], [[1e3], [1e3 + 2]]]), np.ones((2, 2, 1, 1)))
    common = Mixture(np.full(2, 0.5), np.array([[0.0], [500.0]]), np.full((2, 1, 1), 1e9))
    tracks = dataclasses.replace(as_tracks(parts), extras={"common": common})
    with pytest.raises(ValueError, match="No mixture can be learned from the samples: no more than .* of 1000 are"):
        run("mixture_exact", tracks, {"method": "common_proposal"})


def test_a_moment_matched_denominator_that_is_too_narrow_is_refused() -> None:
    parts = Mixture(np.ones((2, 1)), np.array([[[0.0]], [[1.0]]]), np.full((2, 1, 1, 1), 4.0))
    common = Mixture(np.full(2, 0.5), np.array([[0.0], [0.5]]), np.full((2, 1, 1), 1.5))
    tracks = dataclasses.replace(as_tracks(parts), extras={"common": common})
    for values in ({"method": "mmgd"}, {"method": "dls"}):
        with pytest.raises(ValueError, match="has no integral for 1 of 1 pairs.*falls no faster than 'common'"):
            run("mixture_exact", tracks, values)


def test_asymmetric_covariances_are_refused() -> None:
    parts = draw(np.random.default_rng(8), 2)
    tracks = vague(parts)
    assert tracks.mixture is not None
    skew = np.array([[0.0, 0.1], [0.0, 0.0]])
    bent = dataclasses.replace(tracks.mixture, cov=tracks.mixture.cov + skew)
    with pytest.raises(ValueError, match="The 'mixture.cov' of source tracks must be symmetric."):
        run("mixture_average", dataclasses.replace(tracks, mixture=bent), {})
    shared = tracks.extras["common"]
    common = dataclasses.replace(shared, cov=shared.cov + skew)
    with pytest.raises(ValueError, match="The extra 'common' must have symmetric covariances."):
        run("mixture_exact", dataclasses.replace(tracks, extras={"common": common}), {})
