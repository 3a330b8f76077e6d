"""The golden files are what their oracles make: neither drifts from the other."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from oracles import make_golden, make_golden_scenarios


def flat(item: Any) -> list[Any]:
    """All leaves of a JSON value and the keys that lead to them, in order."""
    if isinstance(item, dict):
        return [leaf for key, value in item.items() for leaf in (key, *flat(value))]
    return [leaf for value in item for leaf in flat(value)] if isinstance(item, list) else [item]


def test_the_golden_files_are_made_by_the_oracles(tmp_path: Path) -> None:
    make_golden.main(tmp_path)
    make_golden_scenarios.main(tmp_path)
    names = [sorted(p.relative_to(root) for p in root.rglob("*")) for root in (tmp_path, make_golden.GOLDEN)]
    assert names[0] == names[1]
    for path in tmp_path.glob("*.json"):
        made, kept = (flat(json.loads((root / path.name).read_text())) for root in (tmp_path, make_golden.GOLDEN))
        numbers = [[leaf for leaf in leaves if isinstance(leaf, float)] for leaves in (made, kept)]
        np.testing.assert_allclose(*numbers, rtol=1e-9, atol=1e-9)  # last digits may differ between versions of NumPy
        others = [[leaf for leaf in leaves if not isinstance(leaf, float)] for leaves in (made, kept)]
        assert others[0] == others[1]
    for path in tmp_path.glob("*/*.mcap"):
        assert path.stat().st_size == (make_golden.GOLDEN / path.relative_to(tmp_path)).stat().st_size
