"""Random numbers that depend on who draws them, never on how a study is cut into batches or processes."""

from __future__ import annotations

import zlib

import numpy as np


def stream(seed: int, run: int, role: str) -> np.random.Generator:
    """Return the generator of one role ("truth", a sensor's or a filter's name) in one Monte Carlo run.

    Draw from it step by step: n draws of one step after another equal one draw of all steps.
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(run, zlib.crc32(role.encode()))))
