"""Progress bars with the time left: of studies, and of one long job."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from track_fusion.cli.output import console

if TYPE_CHECKING:
    from track_fusion.study.study import Result, Study


@contextlib.contextmanager
def shown(what: str) -> Iterator[Callable[[float], None]]:
    """Give a function that shows on a terminal which share of a job is done."""
    err = console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as bar:
        task = bar.add_task(what, total=1.0)
        yield lambda share: bar.update(task, completed=share)


def results(studies: Sequence[Study], jobs: int, store: Path | None, *, told: bool = False) -> Iterator[Result]:
    """Run studies; yield each's result as it is done.

    A terminal shows how far each is; elsewhere, if `told`, stderr gets a line a study that is done.
    """
    from track_fusion.study.processes import run_studies

    err = console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    bar = Progress(*columns, console=err, transient=True)
    tasks = {study: bar.add_task(f"{study.scenario}, {study.runs} runs", total=1.0) for study in studies}

    def progress(study: Study, share: float) -> None:
        bar.update(tasks[study], completed=share)

    def interrupted() -> None:
        kept = "; the same command then goes on from there" if store is not None else ""
        err.print(f"Stopping when the pieces at work are done{kept} ...")

    with bar if err.is_terminal else contextlib.nullcontext():
        for result in run_studies(studies, jobs, store, progress, interrupted):
            if told and not err.is_terminal:
                runs = f"{result.study.runs} run{'s' * (result.study.runs > 1)}"
                err.print(f"{result.study.scenario}: {runs}, {result.took_s:.1f} s of one processor")
            yield result
