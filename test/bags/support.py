"""The golden bags, and parameter files that suit them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
GOLDEN = ROOT / "test" / "data" / "golden"
SENSORS = ("sensor_1", "sensor_2")


def expected(name: str) -> dict[str, Any]:
    return json.loads((GOLDEN / f"expected_{name}.json").read_text())


def params_file(folder: Path, oracle: str, **given: Any) -> Path:
    """Write a parameter file (JSON is YAML) as a node reads it, with the parameters of an oracle."""
    names, of_oracle = {"sources": "source_configurations", "layout": "axes"}, expected(oracle)["parameters"]
    rule = f"{of_oracle['state_fusion']}."
    own = {names.get(k, k): v for k, v in of_oracle.items() if "." not in k or k.startswith(rule)}
    topic = "odometry" if oracle == "odometry" else "tracks"
    own |= {f"{s}.topic": f"/{s}/{topic}" for s in SENSORS}
    own |= {"source_types": ["odometry" if oracle == "odometry" else "track_table"] * 2}
    own |= {"fusion_timeout_s": 1000.0, "source_timeout_s": 10_000.0, "max_delay_s": 1000.0, "max_future_s": 10.0}
    own |= {"identity_namespace": "fusion_centre"}
    path = folder / "centre.yaml"
    path.write_text(json.dumps({"fusion_centre": {"ros__parameters": own | given}}))
    return path
