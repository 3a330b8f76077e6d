"""What mixture_exact and mixture_wep share: how a quotient of mixtures is sampled mixand by mixand."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from track_fusion.densities.log_domain import log_sum_exp
from track_fusion.densities.mixture.algebra import LogMixture, product
from track_fusion.densities.mixture.mixture import Mixture, chosen
from track_fusion.densities.mixture.proposals import (
    Proposal,
    Pruned,
    bounded,
    direct_local_sampling,
    heavy_tail,
    inflated_naive,
    laplace_proposals,
)
from track_fusion.densities.mixture.quotient import Laplace
from track_fusion.linalg import Array
from track_fusion.params import param
from track_fusion.rules.base import SourceTracks
from track_fusion.rules.shared.folding import DIAGNOSTICS, Step
from track_fusion.rules.shared.mixtures import ReductionParams


@dataclasses.dataclass(frozen=True)
class QuotientParams(ReductionParams):
    """How a quotient of mixtures becomes a mixture, and from how many samples."""

    proposal: str = param(
        "bounded",
        "what dls samples from: the naive mean with a component's covariance (ingis), Laplace's approximation (lagis), "
        "that with heavy tails (heavy_tail), or that and the Gaussian above the mixand in turn (bounded)",
        choices=("ingis", "lagis", "heavy_tail", "bounded"),
    )
    samples: int = param(1000, "samples in all, for whatever is not sampled mixand by mixand", low=10)
    mixand_samples: int = param(100, "samples for dls, each mixand", low=10)
    default_variance: float = param(
        0.0, "smallest variance of any axis that ingis samples with, alpha in (52); 0: the components' own", low=0.0,
        unit="axis unit^2",
    )  # fmt: skip
    prune_nats: float = param(14.0, "mixands this far below the largest are not sampled", low=0.0, unit="nat")
    em_components: int = param(
        0, "components that expectation maximisation fits; 0: as many as the larger mixture", low=0
    )

    def points(self, tracks: SourceTracks) -> int:
        """Return the most points that the fusion of two sources samples."""
        return max(self.samples, self.largest_product(tracks) * self.mixand_samples)

    def learned_count(self, first: Mixture, second: Mixture) -> int:
        """Return how many components expectation maximisation fits."""
        return self.em_components or max(first.count, second.count)


def sample_mixands(
    kept: Pruned,
    first: Mixture,
    second: Mixture,
    approximate: Callable[[], Laplace],
    above: Callable[[Laplace], tuple[Array, Array]],
    params: QuotientParams,
    rng: np.random.Generator,
) -> tuple[Mixture, dict[str, NDArray[Any]]]:
    """Direct local sampling, Algorithm 5, of the mixands kept of the quotient of first and second.

    Parameters
    ----------
    kept : Pruned            (..., P) mixands
    approximate : callable   () -> Laplace's approximation of these mixands, for the proposals that need it
    above : callable         it -> means (..., P, n) and covariances (..., P, n, n) of the Gaussians above the mixands
    params, rng              proposal, number of samples, generator

    Returns
    -------
    Mixture (..., P) of weight 1, and the diagnostics ess, log_eta and pruned (...)
    """
    if params.proposal == "ingis":
        proposal = inflated_naive(kept.quotient, first, second, params.default_variance, kept.order)
    else:
        near = approximate()
        proposal = PROPOSALS[params.proposal](near, *above(near))
    local = direct_local_sampling(kept.quotient, proposal, rng, params.mixand_samples)
    ess = (local.mixture.weight * local.ess).sum(-1) / params.mixand_samples
    return local.mixture, {"ess": ess, "log_eta": local.log_eta, "pruned": kept.share}


#: What dls samples from, of Laplace's approximation and of the means and covariances above the mixands.
PROPOSALS: dict[str, Callable[[Laplace, Array, Array], Proposal]] = {
    "lagis": lambda near, mean, cov: laplace_proposals(near),
    "heavy_tail": lambda near, mean, cov: heavy_tail(near, cov),
    "bounded": bounded,
}


def multiply(first: Mixture, second: Mixture) -> Step:
    """Fuse naively, with nothing divided out: nothing is sought or sampled."""
    whole = product(LogMixture.of(first), LogMixture.of(second))
    return Step(whole.normalised, None, {"log_eta": log_sum_exp(whole.log_weight)})


def either(take: NDArray[np.bool_], one: Step, other: Step) -> Step:
    """Take, where `take` (...), the step `one`, else `other`; both have a weight of the first, or neither has."""
    omega = None if one.omega is None or other.omega is None else np.where(take, one.omega, other.omega)
    info = {
        name: np.where(take, *(step.info.get(name, DIAGNOSTICS[name][1]) for step in (one, other)))
        for name in {**one.info, **other.info}
    }
    return Step(chosen(take, one.mixture, other.mixture), omega, info)


def closed_form_where(single: NDArray[np.bool_], closed: Callable[[], Step], sampled: Callable[[], Step]) -> Step:
    """Fuse in closed form where every mixture has one component, `single` (...), by sampling elsewhere."""
    if single.all():
        return closed()
    return either(single, closed(), sampled()) if single.any() else sampled()


def has_one_component(mixture: Mixture) -> NDArray[np.bool_]:
    """Tell which mixtures (...) are Gaussian: the other components, if any, have no weight."""
    return np.asarray((mixture.weight > 0.0).sum(-1) == 1)


def heaviest(mixture: Mixture) -> Mixture:
    """Return the heaviest component (..., 1) of each mixture (..., C)."""
    return mixture.take(mixture.weight.argmax(-1)[..., None])
