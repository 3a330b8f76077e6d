"""Finished pieces of studies on disk: a study that was interrupted goes on from there."""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np

from track_fusion.study.rows import Outcomes


def folder_of_pieces(store: Path) -> Path:
    """Return the folder of this program's pieces; those of another program go: they would never be used again."""
    folder = store / fingerprint()
    folder.mkdir(parents=True, exist_ok=True)
    for other in store.iterdir():
        if other != folder and other.is_dir():
            shutil.rmtree(other)
    return folder


def keep(path: Path, outcomes: Outcomes, took_s: float) -> None:
    """Write a piece; the file is there whole or not at all."""
    named = {f"outcome/{name}": array for name, array in outcomes.items()}
    with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
        np.savez(file, allow_pickle=False, **named, took_s=took_s)
    os.replace(file.name, path)


def kept(path: Path) -> tuple[Outcomes, float]:
    """Read a piece: its outcomes, and the processor time that it took in seconds."""
    with np.load(path) as arrays:
        outcomes = {n.removeprefix("outcome/"): arrays[n] for n in arrays.files if n.startswith("outcome/")}
        return outcomes, float(arrays["took_s"])


def fingerprint() -> str:
    """Name everything that results may depend on besides the study itself: this program, Python, NumPy, SciPy."""
    import scipy

    digest = hashlib.sha256(f"{sys.version_info[:2]} {np.__version__} {scipy.__version__}".encode())
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
