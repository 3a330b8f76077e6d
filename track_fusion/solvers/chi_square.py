"""Chi-square quantiles, without the second that importing scipy.stats takes at every start of a node."""

from __future__ import annotations

from scipy.special import gammaincinv


def chi_square_quantile(probability: float, dof: float) -> float:
    """Value that a chi-square variable of `dof` degrees of freedom stays below with `probability`."""
    return float(2.0 * gammaincinv(0.5 * dof, probability))
