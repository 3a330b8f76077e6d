"""Run track-fusion in this process or in one of its own, and read its JSON as strictly as the standard says."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

from click.testing import CliRunner, Result

from track_fusion.cli.app import cli

ROOT = Path(__file__).resolve().parents[2]
DEADLINE_S = 60.0


def run(*words: str, stdin: str | bytes | None = None) -> Result:
    """Run a command in this process; an exception that would be a traceback fails the test."""
    result = _runner().invoke(cli, list(words), input=stdin, catch_exceptions=False, prog_name="track-fusion")
    assert isinstance(result, Result)
    return result


def _runner() -> CliRunner:
    try:
        return CliRunner(mix_stderr=False)  # click 8.1; later ones always keep the streams apart
    except TypeError:
        return CliRunner()


def run_process(
    *words: str, stdin: str = "", script: str = "", env: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a command in a process of its own; `script` replaces `-m track_fusion.cli`."""
    start = ["-c", script] if script else ["-m", "track_fusion.cli"]
    return subprocess.run(
        [sys.executable, *start, *words],
        cwd=ROOT,
        env={**os.environ, **(env or {})},
        input=stdin,
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
    )


def strict_json(text: str) -> Any:
    """Parse JSON, refusing NaN and Infinity."""

    def refuse(constant: str) -> NoReturn:
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(text, parse_constant=refuse)


def refusal(result: Result) -> str:
    """Return the one line with which wrong input was refused."""
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
    assert result.stderr.endswith("\n")
    return str(result.stderr[:-1])
