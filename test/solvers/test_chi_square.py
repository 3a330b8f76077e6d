"""Chi-square quantiles against scipy.stats, which the library does not import."""

from __future__ import annotations

import pytest
from scipy.stats import chi2

from track_fusion.solvers.chi_square import chi_square_quantile


@pytest.mark.parametrize("probability", [0.0, 1e-6, 0.5, 0.99, 0.9999, 1.0 - 1e-9, 1.0])
@pytest.mark.parametrize("dof", [1, 2, 4, 9, 300])
def test_quantiles_are_those_of_scipy_stats(probability: float, dof: int) -> None:
    assert chi_square_quantile(probability, dof) == pytest.approx(chi2.ppf(probability, dof), rel=1e-10)
