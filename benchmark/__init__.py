"""Benchmarks: ratios measured in one process on one core; `python -m benchmark`."""

from __future__ import annotations

import os

# Before NumPy is loaded: its thread pools would measure the machine's other cores.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"):
    os.environ[_name] = "1"
