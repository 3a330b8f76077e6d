"""What the examples of Sharma et al., section 5.2, share: two given densities of the plane, fused once."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property

import numpy as np

from track_fusion.densities.mixture.mean_density import Kind, log_mean_density
from track_fusion.densities.mixture.mixture import Mixture, log_pdf
from track_fusion.densities.on_grid import grid, kl_on_grid, moments_on_grid
from track_fusion.linalg import Array
from track_fusion.metrics.accuracy import Estimate
from track_fusion.random_streams import stream
from track_fusion.rules import FusedTracks, SourceTracks
from track_fusion.study.rows import Outcomes, Progress, chosen, row_by_row
from track_fusion.study.rule_choice import RuleChoice

#: Weight of both densities in every fusion whose weights are not sought.
HALF = (0.5, 0.5)
#: Samples of one fusion by sampling, as in the paper.
SAMPLES = 5000
#: Covariances of (75)-(76), and of every mixture's two components.
COVS = np.array([[[2.5, -1.0], [-1.0, 1.2]], [[0.8, -0.5], [-0.5, 4.0]]])
#: Where densities are summed up: spacing a ninth of the smallest standard deviation, hardly anything outside.
POINTS = grid(np.full(2, -14.0), np.full(2, 14.0), 280)

HMD_GA = RuleChoice.of("harmonic_mean", criterion="given", weights=HALF)
HMD_S = RuleChoice.of("harmonic_mean", "sampled", criterion="given", weights=HALF, method="sampling", samples=SAMPLES)
GMD_S = RuleChoice.of("geometric_mean_sampling", criterion="given", weights=HALF, samples=SAMPLES)


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two densities to be fused: parts, weight (2, C), mean (2, C, 2), cov (2, C, 2, 2)."""

    parts: Mixture

    def log_mean(self, points: Array, kind: Kind) -> Array:
        """Logarithm (S,) of the harmonic or geometric mean density, not normalised, at points (S, 2)."""
        return log_mean_density(log_pdf(self.parts, points[None]), np.array(HALF), kind)

    def by_rule(self, choice: RuleChoice) -> Row:
        """Fuse by a rule."""
        return Row(self, lambda rng: choice.fuse(SourceTracks.of(self.parts, seed=rng)), choice.random)

    def by_grid(self, kind: Kind, inflation: float = 1.0) -> Row:
        """Take the moments of a mean density by summation; `inflation`: those that samples of wider densities have."""
        wide = dataclasses.replace(self.parts, cov=inflation * self.parts.cov)

        def fuse(rng: np.random.Generator) -> FusedTracks:
            drawn, meant = (np.logaddexp(*log_pdf(parts, POINTS[None])) for parts in (wide, self.parts))
            return FusedTracks(*moments_on_grid(self.log_mean(POINTS, kind) + drawn - meant, POINTS))

        return Row(self, fuse)

    @cached_property
    def exact(self) -> Array:
        """Logarithm of the harmonic mean density, not normalised, at POINTS."""
        return self.log_mean(POINTS, "harmonic")

    def divergence(self, fused: FusedTracks) -> float:
        """Kullback-Leibler divergence of the exact harmonic mean density from what was fused, in nats."""
        return float(kl_on_grid(self.exact, log_pdf(fused.density, POINTS)))

    def scores(self, rules: Sequence[RuleChoice], runs: Sequence[int], seed: int, progress: Progress) -> Outcomes:
        """Fuse by any rules: divergence of the exact harmonic mean density from each result, (R,)."""
        outcomes = simulate({f"given-{c.name}": self.by_rule(c) for c in rules}, runs, seed, progress)
        return {name: values for name, values in outcomes.items() if name.endswith("/kld_nats")}


@dataclasses.dataclass(frozen=True)
class Row:
    """One fusion of a pair: a function of a generator, and whether it draws from it."""

    pair: Pair
    fuse: Callable[[np.random.Generator], FusedTracks]
    random: bool = False


def simulate(rows: Mapping[str, Row], runs: Sequence[int], seed: int, progress: Progress, only: str = "") -> Outcomes:
    """Fuse by each row whose name starts with `only`; a row that draws nothing, once for all runs.

    Returns
    -------
    {row/mean: (R, 2), row/cov: (R, 2, 2), row/kld_nats: (R,)}, and for a mixture of M components row/weight
    (R, M), row/means (R, M, 2), row/covs (R, M, 2, 2)
    """

    def measure(row: Row) -> Outcomes:
        each = runs if row.random else runs[:1]
        columns = _columns(row.pair, [row.fuse(stream(seed, run, "samples")) for run in each])
        return columns if row.random else {name: np.repeat(values, len(runs), 0) for name, values in columns.items()}

    return row_by_row(chosen(rows, only), progress, measure)


def _columns(pair: Pair, fused: Sequence[FusedTracks]) -> Outcomes:
    """Put the results of several runs together."""
    columns = {
        "mean": np.stack([f.mean for f in fused]),
        "cov": np.stack([f.cov for f in fused]),
        "kld_nats": np.array([pair.divergence(f) for f in fused]),
    }
    mixtures = [f.mixture for f in fused if f.mixture is not None]
    if mixtures:
        columns["weight"], columns["means"], columns["covs"] = (
            np.stack([getattr(m, field) for m in mixtures]) for field in ("weight", "mean", "cov")
        )
    return columns


def figures(rows: Mapping[str, Row], outcomes: Outcomes) -> dict[str, Estimate]:
    """Mean, determinant of the covariance and divergence of every row sampled."""
    measured = {}
    for name, row in rows.items():
        if f"{name}/mean" not in outcomes:
            continue
        mean, cov = outcomes[f"{name}/mean"], outcomes[f"{name}/cov"]
        columns = {
            "determinant_1": np.linalg.det(cov),
            "mean_x_1": mean[:, 0],
            "mean_y_1": mean[:, 1],
            "kld_nats": outcomes[f"{name}/kld_nats"],
        }
        for column, values in columns.items():
            measured[f"{name}/{column}"] = Estimate.mean(values) if row.random else Estimate.exact(values[0])
    return measured
