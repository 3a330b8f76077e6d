"""Random fusion problems of Ahmed's section 5: two mixtures and what they share, and their fused density on a grid."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.log_domain import normalised
from track_fusion.densities.mixture.mixture import Mixture, log_pdf, stacked
from track_fusion.densities.mixture.quotient import exact_bound, exact_quotient
from track_fusion.densities.on_grid import grid, kl_on_grid
from track_fusion.linalg import Array, transpose
from track_fusion.random_streams import stream
from track_fusion.rules import FusedTracks, SourceTracks
from track_fusion.study.chart import Chart, Contours
from track_fusion.study.rows import Outcomes, Progress, run_by_run
from track_fusion.study.rule_choice import RuleChoice

#: Half the sides of the squares in which the sources' and the common information's means lie.
SOURCE_HALF, COMMON_HALF = 14.0, 20.0
#: Covariances are Wishart: so many degrees of freedom, this scale times the unit matrix.
WISHART_DOF, WISHART_SCALE = 10, 0.75
#: Variance with which INGIS samples at least, alpha in (52): the paper's value for these problems.
INGIS_VARIANCE = 5.0

#: Fused densities are known on a grid of so many cells a side, over the square within this distance of the origin.
CELLS, GRID_HALF = 100, 28.0
GRID = grid(np.full(2, -GRID_HALF), np.full(2, GRID_HALF), CELLS)
CELL_AREA = (2.0 * GRID_HALF / CELLS) ** 2
#: What pictures show of it.
SHOWN_HALF = 20.0
#: Contours are drawn at these shares of the true density's peak.
LEVELS = (0.03, 0.1, 0.3, 0.7)
#: Pictures end where nothing reaches this share.
FAINTEST = 0.003


def random_mixture(rng: np.random.Generator, count: int, half: float) -> Mixture:
    """Draw a mixture of two axes: uniform weights and means, Wishart covariances, which have mean 7.5 times the unit.

    Parameters
    ----------
    rng, count    generator, number of components
    half : float  half the side of the square of the means
    """
    weight = rng.random(count)
    root = rng.normal(size=(count, 2, WISHART_DOF)) * np.sqrt(WISHART_SCALE)
    return Mixture(weight / weight.sum(), rng.uniform(-half, half, (count, 2)), root @ transpose(root))


@dataclasses.dataclass(frozen=True)
class Problem:
    """Two mixtures (C1,), (C2,) of two axes to be fused, and their common information (T,)."""

    first: Mixture
    second: Mixture
    common: Mixture

    @classmethod
    def drawn(cls, rng: np.random.Generator, sources: Sequence[int], common: Sequence[int]) -> Problem:
        """Draw a problem whose numbers of components are among those given, until one is that surely has a solution.

        That is: each mixand of the exact quotient falls below a Gaussian, (55).
        """
        while True:
            first, second = (random_mixture(rng, int(rng.choice(sources)), SOURCE_HALF) for _ in range(2))
            shared = random_mixture(rng, int(rng.choice(common)), COMMON_HALF)
            if exact_bound(exact_quotient(first, second, shared), shared).sure.all():
                return cls(first, second, shared)

    def tracks(self, rng: np.random.Generator) -> SourceTracks:
        """Return what a rule takes; `rng` is for those that sample."""
        return SourceTracks.of(stacked(self.first, self.second), common=self.common, seed=rng)

    def log_exact(self, points: Array = GRID) -> Array:
        """Logarithm of the exactly fused density at points (S, 2), up to a constant: (6)."""
        return log_pdf(self.first, points) + log_pdf(self.second, points) - log_pdf(self.common, points)

    def log_wep(self, omega: float, points: Array = GRID) -> Array:
        """Logarithm of the weighted exponential product at points (S, 2), up to a constant: (7)."""
        return omega * log_pdf(self.first, points) + (1.0 - omega) * log_pdf(self.second, points)


def log_fused(fused: FusedTracks) -> Array:
    """Logarithm on GRID of a fused density: its mixture, or the Gaussian of its moments."""
    return log_pdf(fused.density, GRID)


def shown(log_density: Array) -> NDArray[np.float32]:
    """Cut what pictures show out of a density on GRID, (CELLS^2,) -> (P, P), rows along the second axis."""
    cells = normalised(log_density).reshape(CELLS, CELLS) / CELL_AREA
    inside = np.abs(_centres()) < SHOWN_HALF
    return cells[np.ix_(inside, inside)].T.astype(np.float32)


def _centres() -> Array:
    return GRID.reshape(CELLS, CELLS, 2)[:, 0, 0]


def contour_chart(title: str, densities: Mapping[str, NDArray[Any]]) -> Chart:
    """Draw densities as `shown` gives them, all at the same levels, shares of the first one's peak.

    The first one's label is to say what it is; the others' what they approximate it by.
    """
    axis = _centres()[np.abs(_centres()) < SHOWN_HALF]
    peak = float(next(iter(densities.values())).max())
    # Rounded to what can be seen, to keep a report small.
    shares = {label: np.round(np.asarray(z, float) / peak, 4) for label, z in densities.items()}
    used = np.any([share >= FAINTEST for share in shares.values()], 0)
    rows, columns = (_range(used.any(1 - axis)) for axis in range(2))
    drawn = [Contours(name, axis[columns], axis[rows], z[rows, columns], LEVELS) for name, z in shares.items()]
    percent = ", ".join(f"{level:.0%}" for level in LEVELS)
    drawn[0] = dataclasses.replace(drawn[0], label=f"{drawn[0].label}: {percent} of its peak")
    return Chart(title, "first axis", "second axis", contours=tuple(drawn), equal=True)


def _range(used: NDArray[np.bool_]) -> slice:
    """Return where all that is used lies."""
    at = np.flatnonzero(used)
    return slice(int(at[0]), int(at[-1]) + 1)


def scores(
    draw: Callable[[int, int], Problem], rules: Sequence[RuleChoice], runs: Sequence[int], seed: int, progress: Progress
) -> Outcomes:
    """Fuse the problems draw(seed, run) by any rules: divergence of the exactly fused density from what each gives."""

    def one(run: int, tell: Progress) -> dict[str, Array]:
        problem = draw(seed, run)
        truth = problem.log_exact()
        fused = {choice.name: choice.fuse(problem.tracks(stream(seed, run, "fusion"))) for choice in rules}
        tell(1.0)
        return {f"given-{name}/kld_nats": kl_on_grid(truth, log_fused(tracks)) for name, tracks in fused.items()}

    return run_by_run(runs, progress, one)
