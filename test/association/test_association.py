"""Association: the gate finds what trying all pairs finds, the assignment what trying all assignments finds."""

import itertools
import tracemalloc

import numpy as np
import pytest
from scipy.stats import chi2

from track_fusion.association import assignment
from track_fusion.association import gate as gating
from track_fusion.association.assignment import assign, nearest_neighbour, nearest_pairs
from track_fusion.association.boxes import points_in_boxes
from track_fusion.association.gate import Candidates, gate

GAMMA = float(chi2.ppf(0.99, 4))
POSITION = (0, 1)


def scene(rng, count, area, vague=0.0):
    """Tracks over an area; a share `vague` of them has a position a hundred times vaguer."""
    mean = np.concatenate([rng.uniform(0, area, (count, 2)), rng.normal(0, 3, (count, 2))], 1)
    a = rng.normal(size=(count, 4, 4))
    cov = a @ np.swapaxes(a, 1, 2) + 0.1 * np.eye(4)
    scale = np.where(rng.random(count) < vague, 100.0, 1.0)[:, None] * np.array([1.0, 1.0, 0.3, 0.3])
    return mean, scale[:, :, None] * cov * scale[:, None, :]


def brute_force_gate(row_mean, row_cov, col_mean, col_cov, gamma):
    found = {}
    for i in range(len(row_mean)):
        for j in range(len(col_mean)):
            s, r = row_cov[i] + col_cov[j], row_mean[i] - col_mean[j]
            distance = r @ np.linalg.inv(s) @ r
            if distance <= gamma:
                found[i, j] = distance, np.linalg.slogdet(s)[1]
    return found


@pytest.mark.parametrize(
    ("rows", "cols", "area", "vague"),
    [(0, 5, 10, 0), (5, 0, 10, 0), (1, 1, 1, 0), (20, 30, 40, 0.2), (80, 90, 300, 0.0), (80, 90, 300, 0.1),
     (120, 60, 40, 0.5)],
)  # fmt: skip
@pytest.mark.parametrize("position", [POSITION, ()])
def test_gate_equals_trying_all_pairs(rows, cols, area, vague, position):
    rng = np.random.default_rng(rows + cols)
    tracks = *scene(rng, rows, area, vague), *scene(rng, cols, area, vague)
    wanted = brute_force_gate(*tracks, GAMMA)
    found = gate(*tracks, GAMMA, position)
    assert list(zip(found.row.tolist(), found.col.tolist(), strict=True)) == sorted(wanted)
    pairs = sorted(wanted)
    np.testing.assert_allclose(found.distance, [wanted[p][0] for p in pairs], rtol=1e-9)
    np.testing.assert_allclose(found.logdet, [wanted[p][1] for p in pairs], rtol=1e-9, atol=1e-9)


def test_gate_does_not_depend_on_the_size_of_its_pieces(monkeypatch):
    rng = np.random.default_rng(7)
    tracks = *scene(rng, 150, 60, 0.2), *scene(rng, 150, 60, 0.2)
    whole = [gate(*tracks, GAMMA, p) for p in (POSITION, ())]
    monkeypatch.setattr(gating, "PIECE", 17)
    monkeypatch.setattr(gating, "SEARCH_ROWS", 5)
    for before, position in zip(whole, (POSITION, ()), strict=True):
        after = gate(*tracks, GAMMA, position)
        assert len(after.row) > 100
        for name in ("row", "col", "distance", "logdet"):
            np.testing.assert_array_equal(getattr(before, name), getattr(after, name))


def test_gate_keeps_its_share_of_true_pairs():
    rng = np.random.default_rng(8)
    truth, cov = scene(rng, 4000, 1e6)
    lower = np.linalg.cholesky(cov)
    first, second = (truth + (lower @ rng.normal(size=(4000, 4, 1)))[..., 0] for _ in range(2))
    found = gate(first, cov, second, cov, GAMMA, POSITION)
    share = (found.row == found.col).sum() / 4000
    assert abs(share - 0.99) < 4 * np.sqrt(0.99 * 0.01 / 4000)


def component_of(pairs, row):
    """All pairs connected with a row."""
    rows, cols = {row}, set()
    while True:
        new = {p for p in pairs if p[0] in rows or p[1] in cols}
        if {p[0] for p in new} <= rows and {p[1] for p in new} <= cols:
            return new
        rows |= {p[0] for p in new}
        cols |= {p[1] for p in new}


def cost_of(choice, candidates):
    """Total cost of an assignment as doc/fusion-centre.md states it; infinite where it is none."""
    pairs = {(i, j): (d + v, v) for i, j, d, v in zip(*(getattr(candidates, f).tolist() for f in FIELDS), strict=True)}
    taken = [j for j in choice if j >= 0]
    if len(taken) != len(set(taken)) or any(j >= 0 and (i, j) not in pairs for i, j in enumerate(choice)):
        return np.inf
    total = 0.0
    for i, j in enumerate(choice):
        own = component_of(pairs, i)
        if own:
            total += pairs[i, j][0] if j >= 0 else GAMMA + max(pairs[p][1] for p in own)
    return total


FIELDS = ("row", "col", "distance", "logdet")


@pytest.mark.parametrize("seed", range(40))
def test_assignment_is_the_cheapest_of_all(seed):
    rng = np.random.default_rng(seed)
    rows, cols = rng.integers(1, 6, 2)
    found = gate(*scene(rng, rows, 12), *scene(rng, cols, 12), GAMMA, POSITION)
    best = min(cost_of(c, found) for c in itertools.product(range(-1, cols), repeat=rows))
    assert cost_of(assign(found, rows, cols, GAMMA).tolist(), found) == pytest.approx(best, abs=1e-9)


def test_a_miss_costs_the_gate_and_the_largest_determinant_of_its_component():
    """Row 0 alone with column 0 and row 1 missed would cost .1 + gamma + 8, against 5 + 13 for both rows."""
    found = Candidates(np.array([0, 0, 1]), np.array([0, 1, 0]), np.array([0.1, 5.0, 5.0]), np.array([0.0, 0.0, 8.0]))
    np.testing.assert_array_equal(assign(found, 2, 2, GAMMA), [1, 0])


def test_a_miss_is_cheaper_than_a_pair_that_makes_another_miss_its_own():
    """Rows 0 and 1 want column 0; the vague row 0 has the larger determinant, and is left out."""
    found = Candidates(np.array([0, 1]), np.array([0, 0]), np.array([0.1, 3.0]), np.array([8.0, 0.0]))
    np.testing.assert_array_equal(assign(found, 2, 1, GAMMA), [-1, 0])


@pytest.mark.parametrize("seed", range(8))
def test_sparse_solution_equals_dense(seed, monkeypatch):
    rng = np.random.default_rng(seed)
    found = gate(*scene(rng, 70, 60, 0.1), *scene(rng, 60, 60, 0.1), GAMMA, POSITION)
    monkeypatch.setattr(assignment, "FEW_COMPONENTS", 10**9)
    monkeypatch.setattr(assignment, "FEW_PAIRS", 10**9)
    dense = assign(found, 70, 60, GAMMA)
    monkeypatch.setattr(assignment, "FEW_COMPONENTS", 0)
    np.testing.assert_array_equal(assign(found, 70, 60, GAMMA), dense)
    assert (dense < 0).any()


def test_a_pair_at_the_very_gate_is_taken():
    """It costs exactly a miss: within the gate no pair costs more."""
    found = Candidates(np.array([0, 0]), np.array([0, 1]), np.array([GAMMA, GAMMA]), np.array([2.0, 2.0]))
    assert assign(found, 1, 2, GAMMA)[0] >= 0


def test_nothing_to_assign():
    none = gate(np.zeros((0, 4)), np.zeros((0, 4, 4)), np.zeros((3, 4)), np.tile(np.eye(4), (3, 1, 1)), GAMMA, POSITION)
    assert assign(none, 0, 3, GAMMA).shape == (0,)
    far = gate(np.zeros((2, 4)), np.tile(np.eye(4), (2, 1, 1)), *scene(np.random.default_rng(0), 3, 1), 1e-9, POSITION)
    np.testing.assert_array_equal(assign(far, 2, 3, GAMMA), [-1, -1])


@pytest.mark.parametrize("area", [20_000.0, 1_000.0])
def test_ten_thousand_by_ten_thousand_in_bounded_memory(area):
    """All pairs would take 100 million distances; the crowded scene has a million pairs close enough to try."""
    rng = np.random.default_rng(9)
    count = 10_000
    mean = np.concatenate([rng.uniform(0, area, (count, 2)), rng.normal(0, 5, (count, 2))], 1)
    cov = np.tile(np.diag([1.0, 1.0, 0.2, 0.2]), (count, 1, 1))
    seen = mean + rng.normal(size=mean.shape) * np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    order = rng.permutation(count)
    tracemalloc.start()
    try:
        found = nearest_neighbour(seen[order], cov[order], mean, cov, GAMMA, POSITION)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert (found == order).mean() > 0.98
    assert peak < 64e6


# ---- points in boxes ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(40))
def test_points_in_boxes_are_those_of_the_definition(seed):
    rng = np.random.default_rng(seed)
    count, boxes = rng.integers(0, 60, 2)
    points = rng.uniform([0.0, -np.pi], [10.0, np.pi], (count, 2))
    centre = rng.uniform([-1.0, -np.pi], [11.0, np.pi], (boxes, 2))
    half = rng.exponential(1.0, (boxes, 2)) * rng.choice([1e-3, 1.0, 30.0], (boxes, 1))
    half[:, 1] = np.minimum(half[:, 1], np.pi)
    gap = points[None] - centre[:, None]
    for period in (np.inf, 2.0 * np.pi):
        turned = gap.copy()
        if period < np.inf:
            turned[..., 1] = np.remainder(gap[..., 1] + np.pi, period) - np.pi
        wanted = np.argwhere((np.abs(turned) <= half[:, None]).all(-1)).reshape(-1, 2)
        np.testing.assert_array_equal(
            np.stack(points_in_boxes(points, centre - half, centre + half, period), 1), wanted
        )


@pytest.mark.parametrize("seed", range(20))
def test_sides_belong_to_a_box_and_points_may_coincide(seed):
    rng = np.random.default_rng(seed)
    count, boxes = rng.integers(1, 30, 2)
    points, centre = rng.integers(0, 4, (count, 2)) * 1.0, rng.integers(-2, 7, (boxes, 2)) * 1.0
    half = rng.integers(0, 3, (boxes, 2))
    wanted = np.argwhere((np.abs(points[None] - centre[:, None]) <= half[:, None]).all(-1)).reshape(-1, 2)
    np.testing.assert_array_equal(np.stack(points_in_boxes(points, centre - half, centre + half), 1), wanted)


# ---- points in pairs ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(10))
def test_nearest_pairs_have_the_least_total_distance_with_a_miss_at_reach(seed):
    rng = np.random.default_rng(seed)
    first, second = rng.uniform(0, 4, (rng.integers(0, 5), 2)), rng.uniform(0, 4, (rng.integers(0, 5), 2))
    row, col = nearest_pairs(first, second, 1.5)
    assert len(set(row)) == len(set(col)) == len(row)
    taken = np.linalg.norm(first[row] - second[col], axis=1)
    assert (taken < 1.5).all()
    few, many = sorted((first, second), key=len)
    best = min(
        sum(min(np.linalg.norm(few[i] - many[j]), 1.5) for i, j in enumerate(order))
        for order in itertools.permutations(range(len(many)), len(few))
    )
    assert taken.sum() + 1.5 * (len(few) - len(row)) == pytest.approx(best)


@pytest.mark.parametrize("seed", range(20))
def test_components_are_those_of_a_graph_search(seed):
    """In plain numbers and by a graph: the same pairs together, whatever their order."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, assignment.FEW_PAIRS + 1)) if seed else assignment.FEW_PAIRS
    cells = rng.permutation(60 * 60)[:count]
    row, col = np.divmod(cells, 60)
    neighbours = {}
    for i, j in zip(row.tolist(), col.tolist(), strict=True):
        neighbours.setdefault(("row", i), set()).add(("col", j))
        neighbours.setdefault(("col", j), set()).add(("row", i))
    wanted, left = set(), set(neighbours)
    while left:
        part, front = set(), [min(left)]
        while front:
            if (node := front.pop()) not in part:
                part.add(node)
                front += neighbours[node]
        wanted.add(frozenset(k for k, i in enumerate(row.tolist()) if ("row", i) in part))
        left -= part
    for repeats in (1, 1 + assignment.FEW_PAIRS // count):  # the second goes by the graph
        label = assignment._components(np.tile(row, repeats), np.tile(col, repeats), 60, 60)
        assert {frozenset((np.flatnonzero(label == k) % count).tolist()) for k in set(label.tolist())} == wanted
