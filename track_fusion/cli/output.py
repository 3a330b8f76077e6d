"""What the commands share in printing: JSON that every reader takes, and tables."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from collections.abc import Iterable, Mapping
from typing import Any

import click
import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from track_fusion.params import specs

#: Width of a table that goes to a file or a pipe.
FILE_WIDTH = 120


def console(*, stderr: bool = False) -> Console:
    """Return a console of the terminal's width, or a wide one for a file."""
    stream = sys.stderr if stderr else sys.stdout
    return Console(stderr=stderr, highlight=False, width=None if stream.isatty() else FILE_WIDTH)


def table(*columns: str, title: str | None = None) -> Table:
    """Return a table without frame, narrow enough for a terminal of 80 columns; long words wrap."""
    bare = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for column in columns:
        bare.add_column(column, overflow="fold")
    return bare


def grid(facts: Iterable[tuple[str, str]]) -> Table:
    """Return names beside texts, slightly indented."""
    pairs = Table.grid(padding=(0, 2, 0, 0))
    for name, text in facts:
        pairs.add_row(f"  {escape(name)}", escape(text))
    return pairs


def plain(value: Any) -> Any:
    """Turn arrays, tuples and dataclasses into what JSON can say; a number that is not finite becomes null."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(v) for v in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def print_json(value: Any, *, indent: int | None = None) -> None:
    """Print valid JSON: no NaN, no Infinity."""
    click.echo(json.dumps(plain(value), indent=indent, allow_nan=False))


def parameters(params: Any) -> list[dict[str, Any]]:
    """Describe each parameter of a dataclass: name, type, default, range, choices, unit, doc."""
    return [
        {
            "name": name,
            "type": "list of " * spec.sequence + spec.kind.__name__,
            "default": default,
            "low": spec.low,
            "low_excluded": spec.strict,
            "high": spec.high,
            "choices": list(spec.choices),
            "unit": spec.unit,
            "wanted": spec.wanted(),
            "doc": spec.doc,
        }
        for name, (spec, default) in specs(params).items()
    ]


def shown_default(default: Any) -> str:
    """Write a default as JSON; a list without entries is one that is not set."""
    return "unset" if default == () else json.dumps(plain(default), ensure_ascii=False)
