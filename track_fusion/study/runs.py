"""Run studies in pieces: by several processes, the same to the last digit whatever their number, kept and resumed."""

from __future__ import annotations

import dataclasses
import hashlib
import multiprocessing
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from track_fusion.params import ParameterError, from_dict
from track_fusion.plugins import is_path
from track_fusion.rules import find_rule
from track_fusion.study.scenario import RuleChoice, Samples, Scenario

#: BLAS in a worker: one thread, so that workers do not fight for cores and sums do not depend on their number.
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclasses.dataclass(frozen=True)
class Work:
    """What is asked of one scenario.

    Attributes
    ----------
    scenario : str                 key, or path of a Python file that defines SCENARIO
    find : callable                scenario -> Scenario, here and in the workers
    runs, seed : int
    only : str                     beginning of the names of the rows wanted
    rules : tuple or None          compare these rules instead of running the scenario's rows
    """

    scenario: str
    find: Callable[[str], Scenario] = dataclasses.field(repr=False)
    runs: int
    seed: int
    only: str = ""
    rules: tuple[RuleSpec, ...] | None = None

    def pieces(self) -> list[range]:
        """Cut the runs; where depends on the scenario alone."""
        size = self.find(self.scenario).piece
        return [range(start, min(start + size, self.runs)) for start in range(0, self.runs, size)]

    def name(self, runs: range) -> str:
        """Name of the file that keeps a piece."""
        what = re.sub(r"[^\w.@-]+", "_", Path(self.scenario).stem if is_path(self.scenario) else self.scenario)
        asked = hashlib.sha256(repr(dataclasses.replace(self, runs=0)).encode())
        for given in (self.scenario, *(spec.rule for spec in self.rules or ())):
            asked.update(Path(given).read_bytes() if is_path(given) else b"")
        return f"{what}-{asked.hexdigest()[:16]}-seed{self.seed}-runs{runs.start}-{runs.stop}.npz"


@dataclasses.dataclass(frozen=True)
class RuleSpec:
    """A rule to compare: key or path of a Python file that defines RULE, its parameters by name, a variant's name."""

    rule: str
    params: tuple[tuple[str, Any], ...] = ()
    variant: str = ""


@dataclasses.dataclass(frozen=True)
class Study:
    """What came of it: the joined samples of all runs, and the processor time they took in seconds."""

    work: Work
    samples: Samples
    took_s: float


def run_studies(
    works: Sequence[Work],
    jobs: int,
    store: Path | None,
    progress: Callable[[Work, float], None],
    interrupted: Callable[[], None] = lambda: None,
) -> Iterator[Study]:
    """Run studies one after the other, their pieces by `jobs` processes.

    Parameters
    ----------
    works : sequence of Work
    jobs : int              processes; the results do not depend on it
    store : Path or None    folder that keeps finished pieces: a study that was interrupted goes on from there. What
                            another version of the program, of NumPy or of SciPy computed is not used
    progress : callable     (work, share done)
    interrupted : callable  called at Ctrl-C, before the pieces that have begun come to their end

    Yields
    ------
    Study    in the order of `works`

    Raises
    ------
    ParameterError    no such scenario, row or rule
    """
    folder = None if store is None else _folder(store)
    with _workers(jobs, interrupted) as pool:
        submitted = [[(runs, _submit(pool, work, runs, folder)) for runs in work.pieces()] for work in works]
        for work, futures in zip(works, submitted, strict=True):
            parts, took_s = [], 0.0
            for runs, future in futures:
                part, seconds = future.result()
                parts.append(part)
                took_s += seconds
                progress(work, runs.stop / work.runs)
            yield Study(work, joined(parts), took_s)


def _folder(store: Path) -> Path:
    """Return the folder of this program's pieces; those of another program go: they would never be used again."""
    folder = store / fingerprint()
    folder.mkdir(parents=True, exist_ok=True)
    for other in store.iterdir():
        if other != folder and other.is_dir():
            shutil.rmtree(other)
    return folder


def joined(parts: Sequence[Samples]) -> Samples:
    """Join the samples of successive runs along their first axes."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


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


def _submit(pool: ProcessPoolExecutor, work: Work, runs: range, folder: Path | None) -> Future[tuple[Samples, float]]:
    path = None if folder is None else folder / work.name(runs)
    if path is not None and path.is_file():
        done: Future[tuple[Samples, float]] = Future()
        done.set_result(_kept(path))
        return done
    return pool.submit(_piece, work, runs, path)


def _piece(work: Work, runs: range, path: Path | None) -> tuple[Samples, float]:
    """Draw the runs of one piece, in a worker; keep them."""
    began, scenario = time.process_time(), work.find(work.scenario)
    if work.rules is None:
        samples = scenario.sample(runs, work.seed, _silent, work.only)
    else:
        assert scenario.compare is not None
        samples = scenario.compare([choice(scenario, spec) for spec in work.rules], runs, work.seed, _silent)
    took_s = time.process_time() - began
    if path is not None:
        _keep(path, samples, took_s)
    return samples, took_s


def _silent(share: float) -> None:
    pass


def _keep(path: Path, samples: Samples, took_s: float) -> None:
    """Write a piece; the file is there whole or not at all."""
    with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
        np.savez(
            file, allow_pickle=False, **{f"sample/{name}": array for name, array in samples.items()}, took_s=took_s
        )
    os.replace(file.name, path)


def _kept(path: Path) -> tuple[Samples, float]:
    with np.load(path) as arrays:
        samples = {n.removeprefix("sample/"): arrays[n] for n in arrays.files if n.startswith("sample/")}
        return samples, float(arrays["took_s"])


def fingerprint() -> str:
    """Name everything that results may depend on besides the work itself: this program, Python, NumPy, SciPy."""
    import scipy

    digest = hashlib.sha256(f"{sys.version_info[:2]} {np.__version__} {scipy.__version__}".encode())
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def choice(scenario: Scenario, spec: RuleSpec) -> RuleChoice:
    """Return a rule with the parameters given; without any, with those that the scenario gives it, else its defaults.

    Raises
    ------
    ParameterError    no such rule, variant or parameter
    """
    rule = find_rule(spec.rule)
    name = f"{rule.key}@{spec.variant}" if spec.variant else rule.key
    ours = {c.name: c for c in scenario.rules}
    if name in ours and not spec.params:
        return ours[name]
    if spec.variant and not spec.params:
        raise ParameterError(f"The scenario '{scenario.key}' has no '{name}'. It has: {', '.join(sorted(ours))}.")
    return RuleChoice(rule.key, from_dict(rule.params, dict(spec.params)), spec.variant)
