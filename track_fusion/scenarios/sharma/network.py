"""What the consistency tests of Sharma et al., sections 6.2 and 6.3, share: local filters, a network, its sink."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from track_fusion.filters.base import Gaussian
from track_fusion.linalg import Array, outer
from track_fusion.metrics.accuracy import Estimate
from track_fusion.metrics.consistency import nees
from track_fusion.peers import Peer, Round, communicate
from track_fusion.random_streams import stream
from track_fusion.study.chart import Chart, Series, bars, ellipse
from track_fusion.study.claim import Claim
from track_fusion.study.rows import Outcomes, Progress, chosen, row_by_row
from track_fusion.study.rule_choice import RuleChoice, fuse_runs, rule_by_rule

RULE_CHOICES = (
    RuleChoice.of("naive"),
    RuleChoice.of("covariance_intersection", criterion="trace"),
    RuleChoice.of("inverse_covariance_intersection", criterion="trace"),
    RuleChoice.of("ellipsoidal_intersection"),
    RuleChoice.of("harmonic_mean", criterion="trace"),
)
#: An assumption of both tests.
TRACE_WEIGHTS = (
    "assumed: weights by the trace, of the fused covariance for CI and ICI, of the inverse covariance of the "
    "denominator (77) for HMD-GA"
)


class Local(NamedTuple):
    """R runs before anything is sent: state (R, n), estimate of each node, and of one filter that saw all.

    Estimates have mean (R, n), cov (R, n, n), or (1, n, n) where all runs have the same.
    """

    state: Array
    nodes: Mapping[str, Gaussian]
    centralised: Gaussian


@dataclasses.dataclass(frozen=True)
class Network:
    """Nodes that estimate, then send.

    Attributes
    ----------
    estimate : callable        (runs, seed) -> Local
    rounds : tuple of Round    who sends to whom; each receiver folds its senders in this order onto its own estimate
    sink : str                 whose fused estimate is judged
    """

    estimate: Callable[[Sequence[int], int], Local]
    rounds: tuple[Round, ...]
    sink: str

    def fused(self, local: Local, choice: RuleChoice, rngs: Sequence[np.random.Generator] | None = None) -> Gaussian:
        """Send estimates through the network, fused by a rule; return the sink's.

        A rule that samples draws from each run's generator in `rngs`.
        """

        def fuse(own: Gaussian, heard: Gaussian, common: Gaussian | None, count: int) -> Gaussian:
            size = max(len(own.cov), len(heard.cov))
            covs = [np.broadcast_to(t.cov, (size, *t.cov.shape[1:])) for t in (own, heard)]
            means = np.stack([own.mean, heard.mean], 1)
            fused = fuse_runs(choice, means, np.stack(covs, 1), rngs)
            return Gaussian(fused.mean, fused.cov)

        peers = {name: Peer(estimate) for name, estimate in local.nodes.items()}
        for sent in self.rounds:
            peers = communicate(peers, sent, fuse)
        return peers[self.sink].density


#: Rows of each reading: one filter that saw all, and the rules.
ROWS: dict[str, RuleChoice | None] = {"centralised": None} | {choice.name: choice for choice in RULE_CHOICES}
#: What the paper calls the rows; those of one picture together, which would not all be told apart in one.
PICTURES = (
    {"centralised": "centralised", "naive": "naive", "harmonic_mean": "HMD-GA"},
    {"covariance_intersection": "CI", "inverse_covariance_intersection": "ICI", "ellipsoidal_intersection": "EI"},
)


def row_name(row: str, reading: str = "") -> str:
    """Name of a row in figures: kf-row, or kf-row@reading."""
    return f"kf-{row}@{reading}" if reading else f"kf-{row}"


def simulate(
    readings: Mapping[str, Network], runs: Sequence[int], seed: int, progress: Progress, only: str = ""
) -> Outcomes:
    """Run the rows whose names start with `only`, in every reading of the network ("" = as printed).

    Returns
    -------
    {row/error: (R, n), row/cov: (R, n, n)} at the sink
    """
    wanted = chosen({row_name(row, reading): (reading, c) for reading in readings for row, c in ROWS.items()}, only)
    local = {reading: readings[reading].estimate(runs, seed) for reading in {r for r, _ in wanted.values()}}

    def measure(row: tuple[str, RuleChoice | None]) -> Outcomes:
        reading, choice = row
        start = local[reading]
        sink = start.centralised if choice is None else readings[reading].fused(start, choice)
        return {"error": sink.mean - start.state, "cov": np.broadcast_to(sink.cov, (len(runs), *sink.cov.shape[1:]))}

    return row_by_row(wanted, progress, measure)


def figures(outcomes: Outcomes) -> dict[str, Estimate]:
    """Trace of the covariance reported and of the errors' own, and NEES over the number of axes."""
    estimates = {}
    for name in _rows(outcomes):
        error, cov = outcomes[f"{name}/error"], outcomes[f"{name}/cov"]
        estimates[f"{name}/reported_trace_1"] = Estimate.mean(np.trace(cov, axis1=1, axis2=2))
        estimates[f"{name}/sample_trace_1"] = Estimate.mean((error**2).sum(1))
        estimates[f"{name}/nees_1"] = Estimate.mean(nees(error, cov) / error.shape[1])
    return estimates


def _rows(outcomes: Outcomes) -> list[str]:
    return [name.removesuffix("/error") for name in outcomes if name.endswith("/error")]


def charts(readings: Mapping[str, str], outcomes: Outcomes) -> list[Chart]:
    """Figs. 6 and 7: covariances at the sink, reported and of the errors; NEES of all rules.

    Parameters
    ----------
    readings : reading -> what to call it in titles
    """
    panels = []
    for reading, title in readings.items():
        for labels in PICTURES:
            lines = [line for row in labels for line in _ellipses(outcomes, row, reading, labels[row])]
            if lines:
                panels.append(Chart(f"{title}, 2 sigma", "x", "y", tuple(lines), equal=True))
    measured = figures(outcomes)
    values = {_label(name): measured[f"{name}/nees_1"] for name in _rows(outcomes)}
    return [*panels, bars("Squared errors over the covariance reported", "NEES / n", values, "consistent")]


def _label(name: str) -> str:
    """Shorten the name of a row: CI@one_row."""
    row, at, reading = name.removeprefix("kf-").partition("@")
    return {**PICTURES[0], **PICTURES[1]}[row] + at + reading


def _ellipses(outcomes: Outcomes, row: str, reading: str, label: str) -> list[Series]:
    """Ellipses of the covariance that a row reports on average, and of its errors."""
    name = row_name(row, reading)
    if f"{name}/error" not in outcomes:
        return []
    error = outcomes[f"{name}/error"]
    floor = 1e-12 * np.eye(error.shape[1])  # a single run's errors have a singular one
    spread, origin = outer(error).mean(0) + floor, np.zeros(error.shape[1])
    reported = ellipse(f"{label}, reported", origin, outcomes[f"{name}/cov"].mean(0))
    return [reported, ellipse(f"{label}, errors", origin, spread, style="dashed")]


def scores(
    network: Network, rules: Sequence[RuleChoice], runs: Sequence[int], seed: int, progress: Progress
) -> Outcomes:
    """Fold by any rules: length of the error at the sink, and NEES over the number of axes, (R,)."""
    local = network.estimate(runs, seed)

    def measure(choice: RuleChoice) -> Outcomes:
        rngs = [stream(seed, run, "rule") for run in runs]
        fused = network.fused(local, choice, rngs)
        error = fused.mean - local.state
        consistency = nees(error, np.broadcast_to(fused.cov, (*error.shape, error.shape[1]))) / error.shape[1]
        return {"error_1": np.linalg.norm(error, axis=1), "consistency_1": consistency}

    return rule_by_rule("kf", rules, progress, measure)


# What the paper says of both tests.


def in_order(text: str, source: str, quantity: str, *rows: str) -> Claim:
    """Claim that a quantity ascends over rows."""
    return Claim.order(text, source, *(f"kf-{row}/{quantity}" for row in rows))


def conservative(text: str, source: str, row: str) -> Claim:
    """Claim that a row's NEES over the number of axes is not above 1."""
    return Claim.below(text, source, 1.0, f"kf-{row}/nees_1")


def common_claims(source: str) -> tuple[Claim, ...]:
    """Claims of both sections."""
    return (
        Claim.near(
            "Centralised fusion is consistent: NEES / n within 0.05 of 1.", source, 1.0, 0.05, "kf-centralised/nees_1"
        ),
        Claim.above("Naive fusion is highly inconsistent: NEES / n above 1.5.", source, 1.5, "kf-naive/nees_1"),
        conservative("HMD-GA is consistent here: NEES / n not above 1.", source, "harmonic_mean"),
        in_order("HMD-GA reports the least, then ICI, then CI.", source, "reported_trace_1", "harmonic_mean",
                 "inverse_covariance_intersection", "covariance_intersection"),
        in_order("The actual error of HMD-GA is less than ICI's.", source, "sample_trace_1", "harmonic_mean",
                 "inverse_covariance_intersection"),
        in_order("The actual error of HMD-GA is less than CI's.", source, "sample_trace_1", "harmonic_mean",
                 "covariance_intersection"),
    )  # fmt: skip
