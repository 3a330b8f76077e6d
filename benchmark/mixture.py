"""Gaussian mixtures against the loops that users write, and their fusion against a clock."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np

from benchmark import baselines
from benchmark.measure import Result, race
from track_fusion.densities.mixture.exponent import optimise_omega
from track_fusion.densities.mixture.mixture import Mixture, log_pdf
from track_fusion.densities.mixture.proposals import (
    direct_local_sampling,
    indirect_global_sampling,
    inflated_naive,
    laplace_proposal,
)
from track_fusion.densities.mixture.quotient import exact_quotient, laplace, wep_quotient
from track_fusion.densities.mixture.reduction import runnalls
from track_fusion.densities.mixture.sampling import single_shot_em

AXES = 6
#: Runs of which a median is taken.
RUNS = 21


def run() -> Iterator[Result]:
    """Measure log-pdf, reduction, and the sampled fusion of the random problems of Ahmed 5.1."""
    yield _log_pdf()
    yield _runnalls()
    yield from _fusion()


def _mixture(seed: int, count: int, n: int, half: float, dof: int) -> Mixture:
    rng = np.random.default_rng(seed)
    weight, root = rng.random(count), rng.normal(size=(count, n, dof)) * np.sqrt(7.5 / dof)
    return Mixture(weight / weight.sum(), rng.uniform(-half, half, (count, n)), root @ np.swapaxes(root, 1, 2))


def _log_pdf() -> Result:
    mixture = _mixture(1, 100, AXES, 5.0, AXES + 2)
    points = 5.0 * np.random.default_rng(2).normal(size=(10000, AXES))
    parts = mixture.weight, mixture.mean, mixture.cov
    ours, users = race(lambda: log_pdf(mixture, points), lambda: baselines.mixture_log_pdf_loop(*parts, points))
    against = f"scipy loop, {users * 1e3:.3g} ms"
    return Result("log-pdf, 100 components, 10,000 points", ours, against, users / ours, at_least=4.0)


def _runnalls() -> Result:
    mixture = _mixture(3, 100, AXES, 5.0, AXES + 2)
    parts = mixture.weight, mixture.mean, mixture.cov
    start = time.process_time()  # once: it takes seconds
    baselines.runnalls_loop(*parts, 12)
    users = time.process_time() - start
    ours = race(lambda: runnalls(mixture, 12))[0]
    return Result("Runnalls, 100 to 12 components", ours, f"naive loop, {users:.3g} s", users / ours, at_least=300.0)


def _fusion() -> Iterator[Result]:
    """Fuse two mixtures of ten components whose common information has forty."""
    first, second, common = (_mixture(s, c, 2, h, 10) for s, c, h in ((4, 10, 14.0), (5, 10, 14.0), (6, 40, 20.0)))

    def exact_igs() -> object:
        quotient = exact_quotient(first, second, common)
        return indirect_global_sampling(quotient, laplace_proposal(laplace(quotient)), np.random.default_rng(0), 1000)

    def exact_dls() -> object:
        quotient = exact_quotient(first, second, common)
        return direct_local_sampling(quotient, inflated_naive(quotient, first, second), np.random.default_rng(0), 100)

    def wep_igs() -> object:
        found = optimise_omega(first, second, np.random.default_rng(0), 1000)
        return single_shot_em(found.samples, wep_quotient(first, second, found.omega).numerator)

    def wep_dls() -> object:
        rng = np.random.default_rng(0)
        quotient = wep_quotient(first, second, optimise_omega(first, second, rng, 1000).omega)
        return direct_local_sampling(quotient, inflated_naive(quotient, first, second), rng, 100)

    jobs: list[tuple[str, Callable[[], object], float]] = [
        ("exact, IGS, 1000 samples, 10 x 10", exact_igs, 0.015),
        ("exact, DLS, 100 samples a mixand, 10 x 10", exact_dls, 0.020),
        ("WEP, IGS, 1000 samples, 10 x 10", wep_igs, 0.015),
        ("WEP, DLS, 100 samples a mixand, 10 x 10", wep_dls, 0.020),
    ]
    for name, job, limit in jobs:
        seconds = _median(job)
        yield Result(name, seconds, f"{limit * 1e3:.0f} ms", seconds / limit, at_most=1.0)


def _median(job: Callable[[], object]) -> float:
    taken = []
    for _ in range(RUNS):
        start = time.process_time()
        job()
        taken.append(time.process_time() - start)
    return float(np.median(taken))
