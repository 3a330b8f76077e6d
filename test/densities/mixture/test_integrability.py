"""Whether quotients by a mixture have an integral, against directions tried one by one: 200 that have one, 200 not.

Of the valid ones, whose smallest information difference is between .01 and .15: 181 proved, 18 undecided and
taken, 1 left undecided, none refuted. Of the others, -.001 to -.05: all refuted.
"""

from __future__ import annotations

import numpy as np
import pytest
from densities.mixture.integrals import least_ratio, problems, taken, verdict

from track_fusion.densities.mixture.mixture import Mixture
from track_fusion.linalg import Array


def test_valid_quotients_are_proved_or_taken() -> None:
    drawn = problems(1e-2, 0.15)
    verdicts = [verdict(p.cov, p.common) for p in drawn]
    assert not any(v.refuted[0] for v in verdicts)
    proved = sum(bool(v.proved[0]) for v in verdicts)
    undecided = [(p, float(v.least[0])) for p, v in zip(drawn, verdicts, strict=True) if not v.proved[0]]
    for p, least in undecided:
        assert least == pytest.approx(p.difference, rel=1e-3)
    accepted = sum(taken(p) for p, _ in undecided)
    assert proved >= 175
    assert len(undecided) - accepted <= 3
    assert 10 <= accepted <= 25  # there are some that nothing proves


def test_of_quotients_without_integral_none_is_accepted() -> None:
    for p in problems(-0.05, -1e-3):
        found = verdict(p.cov, p.common)
        assert found.refuted[0]
        assert not found.proved[0]
        # The direction shows it, in the units of the axes.
        v = found.direction[0]
        falls = v @ np.linalg.solve(p.cov, v)
        assert np.linalg.norm(v) == pytest.approx(1.0)
        assert all(v @ np.linalg.solve(cov, v) >= falls * (1.0 - 1e-8) for cov in p.common.cov)


def test_proofs_hold() -> None:
    """No direction contradicts what is proved: 20,000 of each problem, and those about the best."""
    for p in problems(1e-2, 0.15):
        if verdict(p.cov, p.common).proved[0]:
            white = np.linalg.inv(np.linalg.cholesky(p.cov))
            image = np.linalg.inv(white @ p.common.cov @ white.T)
            assert least_ratio(np.random.default_rng(2), image) < 1.0


def test_integrable_only_if_some_component_is_wider_in_every_direction() -> None:
    def common(*covs: Array) -> Mixture:
        return Mixture(np.full(len(covs), 1.0 / len(covs)), np.zeros((len(covs), 2)), np.stack(covs))

    def bad(denominator: Mixture) -> bool:
        """Along (1, 1), or an axis, or nowhere."""
        answer = verdict(np.eye(2), denominator)
        assert answer.proved[0] != answer.refuted[0]
        return bool(answer.refuted[0])

    assert not bad(common(2.0 * np.eye(2)))
    assert bad(common(0.5 * np.eye(2)))
    assert bad(common(np.diag([2.0, 0.5])))
    # No component alone is wider, but in each direction one of the two is: along (1, 1) the mean of .5 and 1/30.
    assert not bad(common(np.diag([30.0, 0.8]), np.diag([0.8, 30.0])))
    # Along (1, 1) neither is: the mean of 1/30 and 1/.4 exceeds 1.
    assert bad(common(np.diag([30.0, 0.4]), np.diag([0.4, 30.0])))
    assert bad(common(np.eye(2)))  # flat: a constant has no integral
