"""Other people's implementations as referees: Stone Soup's covariance intersection, scikit-learn's mixtures.

They are imported where they are used: `colcon test` on a robot collects this file without having them.
"""

from __future__ import annotations

import datetime

import numpy as np
import pytest
from densities.mixture.examples import draw

from track_fusion.densities.mixture.mixture import Mixture, log_pdf
from track_fusion.linalg import Array, transpose
from track_fusion.rules import SourceTracks, get_rule

NOW = datetime.datetime(2024, 1, 1)


def _by_stone_soup(mean: Array, cov: Array, weight: float) -> tuple[Array, Array]:
    """Fuse two tracks, the first as detection of weight omega, the second as prediction."""
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.types.detection import GaussianDetection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.prediction import GaussianStatePrediction
    from stonesoup.updater.chernoff import ChernoffUpdater

    n = mean.shape[-1]
    model = LinearGaussian(ndim_state=n, mapping=tuple(range(n)), noise_covar=cov[0])
    detection = GaussianDetection(mean[0], cov[0], timestamp=NOW, measurement_model=model)
    prediction = GaussianStatePrediction(mean[1], cov[1], timestamp=NOW)
    fused = ChernoffUpdater(model, omega=weight).update(SingleHypothesis(prediction, detection))
    return np.asarray(fused.state_vector, float)[:, 0], np.asarray(fused.covar, float)


@pytest.mark.parametrize("key", ["covariance_intersection", "geometric_average"])
@pytest.mark.parametrize("weight", [0.05, 0.5, 0.8])
@pytest.mark.parametrize("n", [1, 2, 6])
def test_intersection_at_given_weights_is_that_of_stone_soup(key: str, weight: float, n: int) -> None:
    rng, rule = np.random.default_rng(n), get_rule(key)
    root = rng.normal(size=(20, 2, n, n + 1))
    mean, cov = 10.0 * rng.normal(size=(20, 2, n)), root @ transpose(root)
    fused = rule(SourceTracks(mean, cov), rule.params(criterion="given", weights=(weight, 1.0 - weight)))
    for k in range(20):
        wanted_mean, wanted_cov = _by_stone_soup(mean[k], cov[k], weight)
        np.testing.assert_allclose(fused.mean[k], wanted_mean, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(fused.cov[k], wanted_cov, rtol=1e-7, atol=1e-9)


def _by_scikit_learn(mixture: Mixture, points: Array) -> Array:
    from sklearn.mixture import GaussianMixture

    one = GaussianMixture(n_components=mixture.count, covariance_type="full")
    one.weights_, one.means_, one.covariances_ = mixture.weight, mixture.mean, mixture.cov
    one.precisions_cholesky_ = transpose(np.linalg.inv(np.linalg.cholesky(mixture.cov)))
    return np.asarray(one.score_samples(points))


@pytest.mark.parametrize(("count", "n"), [(1, 1), (3, 2), (10, 4)])
def test_log_density_of_mixtures_is_that_of_scikit_learn(count: int, n: int) -> None:
    rng = np.random.default_rng(count)
    batch = draw(rng, 5, count=count, n=n).normalised
    points = 6.0 * rng.normal(size=(5, 200, n))  # also where the density is tiny
    found = log_pdf(batch, points)
    assert found.min() < -20
    for k in range(5):
        np.testing.assert_allclose(found[k], _by_scikit_learn(batch.at(k), points[k]), rtol=1e-9, atol=1e-9)
