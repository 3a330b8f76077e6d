"""GOSPA and OSPA against brute force over all pairings, Stone Soup, closed forms and the laws of a metric."""

from __future__ import annotations

import datetime
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from track_fusion.linalg import Array
from track_fusion.metrics.gospa import SetDistance, SetDistanceParams, set_distance


def measured(targets: object, tracks: object, cutoff_m: float = 10.0, order: float = 2.0) -> SetDistance:
    first, second = (np.asarray(x, float).reshape(-1, 2) for x in (targets, tracks))
    return set_distance(first, second, SetDistanceParams(cutoff_m=cutoff_m, order=order))


def pairings(count: int, others: int) -> list[list[tuple[int, int]]]:
    """All ways to pair some of the one with some of the other."""
    return [
        list(zip(rows, cols, strict=True))
        for size in range(min(count, others) + 1)
        for rows in itertools.combinations(range(count), size)
        for cols in itertools.permutations(range(others), size)
    ]


def gospa_by_definition(targets: Array, tracks: Array, c: float, p: float) -> float:
    """The least over all pairings, cut off or not (proposition 1 of the paper)."""
    return min(
        sum(np.hypot(*(targets[i] - tracks[j])) ** p for i, j in pairs)
        + c**p / 2 * (len(targets) + len(tracks) - 2 * len(pairs))
        for pairs in pairings(len(targets), len(tracks))
    ) ** (1 / p)


def ospa_by_definition(targets: Array, tracks: Array, c: float, p: float) -> float:
    """The least over the permutations of the larger set."""
    few, many = sorted((targets, tracks), key=len)
    if not len(many):
        return 0.0
    best = min(
        sum(min(np.hypot(*(few[i] - many[j])), c) ** p for i, j in enumerate(order))
        for order in itertools.permutations(range(len(many)), len(few))
    )
    return ((best + c**p * (len(many) - len(few))) / len(many)) ** (1 / p)


@pytest.mark.parametrize("order", [1.0, 2.0, 3.5])
@pytest.mark.parametrize("cutoff_m", [0.7, 3.0, 20.0])
def test_both_are_the_least_over_all_pairings(order: float, cutoff_m: float) -> None:
    rng = np.random.default_rng(1)
    for count, others in itertools.product(range(5), repeat=2):
        targets, tracks = 2.0 * rng.normal(size=(count, 2)), 2.0 * rng.normal(size=(others, 2))
        got = measured(targets, tracks, cutoff_m, order)
        assert got.gospa == pytest.approx(gospa_by_definition(targets, tracks, cutoff_m, order), rel=1e-12)
        assert got.ospa == pytest.approx(ospa_by_definition(targets, tracks, cutoff_m, order), rel=1e-12)


def by_stone_soup(targets: Array, tracks: Array, c: float, p: float) -> tuple[dict[str, float], float]:
    from stonesoup.metricgenerator.ospametric import GOSPAMetric, OSPAMetric
    from stonesoup.types.state import State

    now = datetime.datetime(2024, 1, 1)
    first, second = ([State(x, timestamp=now) for x in points] for points in (tracks, targets))
    metric, _ = GOSPAMetric(c=c, p=p).compute_gospa_metric(first, second)
    return metric.value, OSPAMetric(c=c, p=p).compute_OSPA_distance(first, second).value


@pytest.mark.parametrize(("count", "others"), [(1, 1), (8, 8), (12, 7), (5, 30), (3, 0), (0, 2)])
def test_stone_soup_says_the_same(count: int, others: int) -> None:
    rng = np.random.default_rng(count)
    targets, tracks = 5.0 * rng.normal(size=(count, 2)), 5.0 * rng.normal(size=(others, 2))
    for c, p in ((3.0, 1), (3.0, 2), (50.0, 2)):
        got, (gospa, ospa) = measured(targets, tracks, c, p), by_stone_soup(targets, tracks, c, p)
        assert got.gospa == pytest.approx(gospa["distance"], rel=1e-9)
        assert got.localisation == pytest.approx(gospa["localisation"], rel=1e-9)
        assert got.missed == pytest.approx(gospa["missed"], rel=1e-9)
        assert got.false == pytest.approx(gospa["false"], rel=1e-9)
        if count and others:  # Stone Soup calls OSPA against nothing 0, where the paper says c
            # It pairs by distance whatever the power, so that only at p = 1 its pairs are surely the best.
            assert got.ospa == pytest.approx(ospa, rel=1e-9) if p == 1 else got.ospa <= ospa * (1 + 1e-9)


def test_the_parts_are_told() -> None:
    """One target seen 3 m off, one missed, two false tracks, one of them 5 m beside a target that has a nearer one."""
    got = measured([(0, 0), (100, 0)], [(3, 0), (0, 5), (50, 0)], cutoff_m=10.0, order=2.0)
    assert (got.target.tolist(), got.track.tolist(), got.distance.tolist()) == ([0], [0], [3.0])
    assert (got.localisation, got.missed, got.false) == (pytest.approx(9.0), 50.0, 100.0)
    assert got.gospa == pytest.approx(np.sqrt(159.0))
    assert got.ospa == pytest.approx(np.sqrt((9.0 + 200.0) / 3))


def test_at_the_cut_off_a_pair_is_none() -> None:
    """To either side of it the distance is the same, so that nothing jumps."""
    inside, at = measured([(0, 0)], [(10 - 1e-9, 0)]), measured([(0, 0)], [(10, 0)])
    assert (len(inside.target), len(at.target)) == (1, 0)
    assert inside.gospa == pytest.approx(at.gospa) == pytest.approx(10.0)
    assert inside.ospa == pytest.approx(at.ospa) == pytest.approx(10.0)


def test_two_empty_sets_are_equal() -> None:
    got = measured([], [])
    assert (got.gospa, got.ospa, got.localisation, got.missed, got.false) == (0.0,) * 5


POINTS = st.lists(st.tuples(*2 * [st.floats(-20, 20)]), max_size=6)


@given(POINTS, POINTS, POINTS, st.floats(0.1, 30.0), st.floats(1.0, 6.0))
def test_both_are_metrics(x: object, y: object, z: object, c: float, p: float) -> None:
    xy, yx, yz, xz, xx = (measured(a, b, c, p) for a, b in ((x, y), (y, x), (y, z), (x, z), (x, x)))
    for name in ("gospa", "ospa"):
        one, other, next_, direct, own = (getattr(d, name) for d in (xy, yx, yz, xz, xx))
        assert one == pytest.approx(other, rel=1e-9, abs=1e-12)
        assert direct <= (one + next_) * (1 + 1e-9) + 1e-9
        assert own == pytest.approx(0.0, abs=1e-12)
    assert (xy.missed, xy.false) == (pytest.approx(yx.false), pytest.approx(yx.missed))
