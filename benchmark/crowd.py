"""Thirty targets that come and go beside each other: GOSPA and switches of the centre's defaults, beside single gates.

    python -m benchmark.crowd RESULTS.jsonl [--seeds 20] [--seconds 30]

One line a run is appended as it ends; a run that is there already is not repeated, so that it can be interrupted.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmark import scenes
from benchmark.identity import PERIOD_S, score, single_gate
from benchmark.scenes import Scene

GATES = (0.99, 0.999, 0.9999, 0.99999)
CENTRES: dict[str, dict[str, Any]] = {f"gate {gate}": single_gate(gate) for gate in GATES} | {"defaults": {}}
#: Metres between a newborn and a living one, share of missed detections, new false tracks a scan, sd of the sources, m.
COMBINATIONS = tuple(itertools.product((4.0, 8.0), (0.0, 0.1), (0.0, 0.3), ((1.0, 3.0), (0.3, 4.0))))
Combination = tuple[float, float, float, tuple[float, float]]


def scene(combination: Combination, seed: int, staggered: bool, seconds: float) -> Scene:
    """Make a crowd."""
    beside_m, misses, false_rate, sds = combination
    rng = np.random.default_rng([seed, *(int(10 * v) for v in (beside_m, misses, false_rate, *sds))])
    targets = scenes.crowd(rng, seconds, PERIOD_S, beside_m)
    reports = []
    for k, sd in enumerate(sds):
        own = scenes.tracked(rng, targets, sd, first=k * staggered, misses=misses, lag=3)
        scans = len(own.told)
        low, high = np.full(2, -60.0), np.full(2, 60.0)
        false = scenes.false_tracks(rng, scans, PERIOD_S, false_rate, low, high, sd)
        reports.append(scenes.joined(own, false))
    return Scene(targets, tuple(reports), (0, int(staggered)))


def rows(path: Path, seeds: int, seconds: float) -> Iterator[dict[str, Any]]:
    """Run what is not in the file yet, every centre in the same scenes, and append it."""
    done = {_key(row) for row in read(path)}
    for seed, staggered, combination in itertools.product(range(seeds), (False, True), COMBINATIONS):
        for name, params in CENTRES.items():
            row: dict[str, Any] = {
                "seed": seed, "trigger": "any_source" if staggered else "all_sources",
                "combination": combination, "centre": name, "seconds": seconds,
            }  # fmt: skip
            if _key(row) in done:
                continue
            result = score(scene(combination, seed, staggered, seconds), **params)
            row |= {"gospa": float(result.gospa.mean()), "switches": result.switches, "ids": result.ids}
            with path.open("a") as file:
                file.write(json.dumps(row) + "\n")
            yield row


def read(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a file; none where it is missing."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def _key(row: dict[str, Any]) -> str:
    return json.dumps([row[name] for name in ("seed", "trigger", "combination", "centre", "seconds")])


def compared(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Tell by trigger and combination how the defaults do against the best single gate, over seeds that all ran."""
    runs: dict[tuple[str, str], dict[str, dict[int, dict[str, Any]]]] = defaultdict(lambda: defaultdict(dict))
    for row in rows:
        runs[row["trigger"], json.dumps(row["combination"])][row["centre"]][row["seed"]] = row
    for (trigger, combination), centres in sorted(runs.items()):
        seeds = set.intersection(*(set(of_seed) for of_seed in centres.values()))
        if len(centres) < len(CENTRES) or not seeds:
            continue
        words = [f"{trigger:11} {combination:24} {len(seeds):2} seeds"]
        for what in ("gospa", "switches"):
            value = {name: np.array([of_seed[k][what] for k in sorted(seeds)]) for name, of_seed in centres.items()}
            best = min((name for name in value if name != "defaults"), key=lambda name: value[name].mean())
            gap = value["defaults"] - value[best]
            error = gap.std(ddof=1) / np.sqrt(len(gap)) if len(gap) > 1 else np.nan
            words.append(
                f"{what} {value['defaults'].mean():8.3f} against {value[best].mean():8.3f} ({best}), "
                f"{gap.mean():+.3f} +- {error:.3f}, {value['defaults'].mean() / value[best].mean() - 1:+.1%}"
            )
        yield "   ".join(words)


def main() -> None:
    """Run, and print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=30.0)
    arguments = parser.parse_args()
    for count, row in enumerate(rows(arguments.results, arguments.seeds, arguments.seconds)):
        if count % 20 == 0:
            print(row, flush=True)
    print("\n".join(compared(read(arguments.results))))


if __name__ == "__main__":
    main()
