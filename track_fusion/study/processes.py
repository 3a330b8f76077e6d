"""Studies by several processes: the same to the last digit whatever their number, kept and resumed."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from track_fusion.study.rows import Outcomes, joined
from track_fusion.study.store import folder_of_pieces, keep, kept
from track_fusion.study.study import Result, Study

#: BLAS in a worker: one thread, so that workers do not fight for cores and sums do not depend on their number.
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def run_studies(
    studies: Sequence[Study],
    jobs: int,
    store: Path | None,
    progress: Callable[[Study, float], None],
    interrupted: Callable[[], None] = lambda: None,
) -> Iterator[Result]:
    """Run studies one after the other, their pieces by `jobs` processes.

    Parameters
    ----------
    studies : sequence of Study
    jobs : int              processes; the results do not depend on it
    store : Path or None    folder that keeps finished pieces: a study that was interrupted goes on from there. What
                            another version of the program, of NumPy or of SciPy computed is not used
    progress : callable     (study, share done)
    interrupted : callable  called at Ctrl-C, before the pieces that have begun come to their end

    Yields
    ------
    Result    in the order of `studies`

    Raises
    ------
    ParameterError    no such scenario, row or rule
    """
    folder = None if store is None else folder_of_pieces(store)
    with _workers(jobs, interrupted) as pool:
        submitted = [[(piece, _submit(pool, study, piece, folder)) for piece in study.pieces()] for study in studies]
        for study, futures in zip(studies, submitted, strict=True):
            parts, took_s = [], 0.0
            for piece, future in futures:
                part, seconds = future.result()
                parts.append(part)
                took_s += seconds
                progress(study, piece.stop / study.runs)
            yield Result(study, joined(parts), took_s)


@contextmanager
def _workers(jobs: int, interrupted: Callable[[], None]) -> Iterator[ProcessPoolExecutor]:
    """Give processes with one BLAS thread each; on an error, what has not begun is dropped."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    pool = ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), initializer=_ignore_interrupts)
    try:
        yield pool
    except KeyboardInterrupt:
        interrupted()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _ignore_interrupts() -> None:
    """Leave Ctrl-C to the parent, which lets pieces that have begun come to their end: they are kept."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _submit(
    pool: ProcessPoolExecutor, study: Study, piece: range, folder: Path | None
) -> Future[tuple[Outcomes, float]]:
    path = None if folder is None else folder / study.name(piece)
    if path is not None and path.is_file():
        done: Future[tuple[Outcomes, float]] = Future()
        done.set_result(kept(path))
        return done
    return pool.submit(_work, study, piece, path)


def _work(study: Study, piece: range, path: Path | None) -> tuple[Outcomes, float]:
    """Simulate one piece, in a worker; keep it."""
    began = time.process_time()
    outcomes = study.simulate(piece)
    took_s = time.process_time() - began
    if path is not None:
        keep(path, outcomes, took_s)
    return outcomes, took_s
