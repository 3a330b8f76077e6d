"""Sharma et al., section 6.2, Figs. 4 and 6: ten nodes, one measurement each, fused on the way to the last."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from track_fusion.filters.base import Gaussian
from track_fusion.filters.iterated_corrector import IteratedCorrector
from track_fusion.filters.kalman import Kalman
from track_fusion.linalg import Array, matvec
from track_fusion.models.measurement import LinearSensor
from track_fusion.peers import Round
from track_fusion.random_streams import stream
from track_fusion.scenarios.sharma import PAPER
from track_fusion.scenarios.sharma import network as shared
from track_fusion.scenarios.sharma.network import RULE_CHOICES, Local, Network, common_claims
from track_fusion.study.claim import Claim
from track_fusion.study.scenario import Scenario

NODES = 10
#: The prior of the state, and of every node.
MEAN, VARIANCE = np.array([0.0, 1.0]), 2.0
#: Variance of each component of a measurement.
NOISE = 0.2
ROUNDS: tuple[Round, ...] = (
    [("S1", "S4"), ("S2", "S5"), ("S3", "S6")],
    [("S4", "S7"), ("S5", "S7"), ("S5", "S8"), ("S6", "S8"), ("S4", "S9"), ("S6", "S9")],
    [("S7", "S10"), ("S8", "S10"), ("S9", "S10")],
)
#: What "heavily bloated" means: the reported trace is so many times that of the errors.
BLOATED = 1.5


def matrix(node: int, components: int) -> Array:
    """Measurement matrix (82) of a node counted from 1, or its first row alone."""
    sine, cosine = np.sin(0.5 * np.pi * node / NODES), np.cos(0.5 * np.pi * node / NODES)
    return np.array([[sine, cosine], [cosine, sine]])[:components]


def estimate(components: int, runs: Sequence[int], seed: int) -> Local:
    """Draw the state, and let every node take in its own measurement of so many components."""
    draws = np.stack([stream(seed, run, "network").standard_normal((1 + NODES, 2)) for run in runs])
    state = MEAN + np.sqrt(VARIANCE) * draws[:, 0]
    axes, noise = ("first", "second")[:components], NOISE * np.eye(components)
    sensors = {f"S{i}": LinearSensor(axes, matrix(i, components), noise) for i in range(1, NODES + 1)}
    zs = {
        name: matvec(sensor.matrix, state) + np.sqrt(NOISE) * draws[:, i, :components]
        for i, (name, sensor) in enumerate(sensors.items(), 1)
    }
    prior, one = Gaussian(np.broadcast_to(MEAN, state.shape), VARIANCE * np.eye(2)[None]), Kalman()
    nodes = {name: one.update(prior, zs[name], sensor)[0] for name, sensor in sensors.items()}
    centralised, _ = IteratedCorrector(one).update(prior, list(zs.values()), list(sensors.values()))
    return Local(state, nodes, centralised)


READINGS = {
    "": Network(partial(estimate, 2), ROUNDS, "S10"),
    "one_row": Network(partial(estimate, 1), ROUNDS, "S10"),
}


#: Titles of Fig. 6 for both readings of the measurements.
TITLES = {"": "S10, (82) as printed", "one_row": "S10, one component each"}


def _bloated(text: str, reading: str) -> Claim:
    needs = tuple(f"{shared.row_name('covariance_intersection', reading)}/{q}_trace_1" for q in ("reported", "sample"))

    return Claim(text, "6.2, Fig. 6", needs, lambda reported, errors: [reported - BLOATED * errors])


SCENARIO = Scenario(
    key="sharma-network-1",
    title="Ten nodes in a network, one measurement each",
    paper=f"{PAPER}, 6.2, Figs. 4 and 6",
    shows="what each rule reports and how large its errors are where the same news comes by several ways",
    published_runs=50_000,
    default_runs=20_000,
    publication_runs=50_000,
    assumptions=(
        "assumed: the topology, a figure: S4 <- S1; S5 <- S2; S6 <- S3; S7 <- S4, S5; S8 <- S5, S6; S9 <- S4, S6; "
        "S10 <- S7, S8, S9; each node folds its senders in this order onto its own estimate",
        "assumed: a common prior, from which the state is drawn and at whose mean every node starts; its mean is "
        "read as (0, 1)",
        shared.TRACE_WEIGHTS,
        "(82) as printed makes all covariances commute, H_5 is singular, and CI returns what S10 has itself; @one_row: "
        "each node measures the first row of (82) alone",
        "heavily bloated: the trace reported is at least 1.5 times that of the errors",
    ),
    simulate=partial(shared.simulate, READINGS),
    figures=shared.figures,
    charts=partial(shared.charts, TITLES),
    claims=(
        *common_claims("6.2, Fig. 6"),
        shared.conservative("CI is conservative: NEES / n not above 1.", "6.2", "covariance_intersection"),
        shared.conservative("ICI is conservative: NEES / n not above 1.", "6.2", "inverse_covariance_intersection"),
        _bloated("The covariance of CI is heavily bloated: (82) as printed.", ""),
        _bloated("The covariance of CI is heavily bloated: one component each.", "one_row"),
    ),
    piece=2500,
    rules=RULE_CHOICES,
    scores=partial(shared.scores, READINGS[""]),
)  # fmt: skip
