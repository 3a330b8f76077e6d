"""`python -m benchmark [--only NAME ...]`: run the benchmarks and print their ratios beside the targets."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Iterable

from benchmark.measure import Result

#: Every benchmark module, by name, in the order of running: each has `run()`, which yields results.
MODULES = (
    "rules", "elliptical", "mixture", "association", "retrodiction", "monte_carlo", "wire", "bag_fuse", "lockstep",
    "latency",
)  # fmt: skip

try:
    from rich.console import Console
    from rich.table import Table
except ImportError:  # plain lines do as well
    Console = None  # type: ignore[assignment, misc]

COLUMNS = ("job", "time", "against", "ratio", "target", "")


def main(arguments: list[str] | None = None) -> int:
    """Run the chosen benchmarks; the exit code is 1 if a target is missed."""
    parser = argparse.ArgumentParser(prog="python -m benchmark", description=__doc__)
    parser.add_argument("--only", nargs="+", choices=MODULES, default=MODULES, metavar="NAME",
                        help=f"run these alone: {', '.join(MODULES)}")  # fmt: skip
    missed = 0
    for name in parser.parse_args(arguments).only:
        module = importlib.import_module(f"benchmark.{name}")
        summary = (module.__doc__ or name).splitlines()[0]
        results = list(module.run())
        _show(f"{name}: {summary}", [_row(r) for r in results])
        missed += sum(r.passed is False for r in results)
    print(f"{missed} target{'s' * (missed != 1)} missed." if missed else "All targets met.")
    return int(missed > 0)


def _row(result: Result) -> tuple[str, ...]:
    time = result.figure or ("" if result.seconds is None else _time(result.seconds))
    ratio = "" if result.ratio is None else f"{result.ratio:.3g} x"
    limits = [(">=", result.at_least), ("<=", result.at_most)]
    target = ", ".join(f"{sign} {value:.3g} x" for sign, value in limits if value is not None)
    verdict = {True: "pass", False: "FAIL", None: ""}[result.passed]
    return result.job, time, result.against, ratio, target, verdict


def _time(seconds: float) -> str:
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds * 1e9:.3g} ns"


def _show(title: str, rows: Iterable[tuple[str, ...]]) -> None:
    rows = list(rows)
    if Console is not None and sys.stdout.isatty():
        table = Table(*COLUMNS, title=title, title_justify="left")
        for row in rows:
            table.add_row(*row, style="red" if row[-1] == "FAIL" else None)
        Console().print(table)
        return
    widths = [max(map(len, column)) for column in zip(COLUMNS, *rows, strict=True)]
    print(f"\n{title}")
    for row in (COLUMNS, *rows):
        print("  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


if __name__ == "__main__":
    sys.exit(main())
