"""Sharma et al., section 6.3, Figs. 5 and 7: five nodes track for five steps, then four of them tell the fifth."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from track_fusion.filters.base import Gaussian
from track_fusion.filters.iterated_corrector import IteratedCorrector
from track_fusion.filters.kalman import Kalman
from track_fusion.linalg import Array, matvec
from track_fusion.models.base import Transition
from track_fusion.models.measurement import LinearSensor
from track_fusion.random_streams import stream
from track_fusion.scenarios.sharma import PAPER
from track_fusion.scenarios.sharma import network as shared
from track_fusion.scenarios.sharma.network import RULE_CHOICES, Local, Network, common_claims
from track_fusion.study.claim import Claim
from track_fusion.study.scenario import Scenario
from track_fusion.trackers.fusion_loop import filtered

STEPS, NODES = 5, 5
#: The prior of the state, and of every node.
MEAN, COV = np.array([0.0, 1.0]), np.array([[2.0, 1.0], [1.0, 2.0]])
#: (83).
TRANSITION, PROCESS_NOISE = np.array([[1.0, 0.5], [0.0, 1.0]]), 0.5 * np.eye(2)
#: (84): of S1, S3, S5, and of S2, S4.
ODD, EVEN = np.diag([0.5, 0.2]), np.diag([0.1, 0.5])
SENSORS = [LinearSensor(("first", "second"), np.eye(2), noise) for noise in (ODD, EVEN, ODD, EVEN, ODD)]
#: How near "almost equal" is.
ALMOST = 1.25


def estimate(runs: Sequence[int], seed: int) -> Local:
    """Draw the state and let every node track it by a Kalman filter; one filter takes in all measurements."""
    draws = np.stack([stream(seed, run, "network").standard_normal((1 + STEPS * (1 + NODES), 2)) for run in runs])
    state = MEAN + matvec(np.linalg.cholesky(COV), draws[:, 0])
    seen: list[list[Array]] = []
    for step in range(STEPS):
        fresh = draws[:, 1 + step * (1 + NODES) :]
        state = matvec(TRANSITION, state) + matvec(np.sqrt(PROCESS_NOISE), fresh[:, 0])
        seen.append([state + matvec(np.sqrt(sensor.noise), fresh[:, 1 + i]) for i, sensor in enumerate(SENSORS)])
    one, motion = Kalman(), Transition.linear(TRANSITION, PROCESS_NOISE)
    start = Gaussian(np.broadcast_to(MEAN, state.shape), COV[None])
    nodes = {}
    for i, sensor in enumerate(SENSORS):
        *_, nodes[f"S{i + 1}"] = filtered(one, start, motion, [zs[i] for zs in seen], sensor)
    *_, centralised = filtered(IteratedCorrector(one), start, motion, seen, SENSORS)
    return Local(state, nodes, centralised)


READINGS = {"": Network(estimate, ([(f"S{i}", "S5") for i in range(1, NODES)],), "S5")}


def _almost(central: Array, harmonic: Array) -> list[Array]:
    return [ALMOST * central - harmonic]


SCENARIO = Scenario(
    key="sharma-network-2",
    title="Five nodes track for five steps, then fuse at one",
    paper=f"{PAPER}, 6.3, Figs. 5 and 7",
    shows="what each rule reports and how large its errors are where tracks share process noise and a prior",
    published_runs=50_000,
    default_runs=20_000,
    publication_runs=50_000,
    assumptions=(
        "assumed: the topology, a figure: S5 <- S1, S2, S3, S4, folded in this order onto its own estimate, once, "
        "after five steps of prediction and update",
        "assumed: a common prior, from which the state is drawn and at whose mean every node starts; its mean is "
        "read as (0, 1)",
        shared.TRACE_WEIGHTS,
        "S1 and S5 have equal covariances, where CI and ICI report the same at any weight: both get 1/2, so that the "
        "errors average; at a weight of 0 or 1 the news of S1 would be lost",
        "almost equal: the trace is at most 1.25 times the other",
    ),
    simulate=partial(shared.simulate, READINGS),
    figures=shared.figures,
    charts=partial(shared.charts, {"": "S5"}),
    claims=(
        *common_claims("6.3, Fig. 7"),
        Claim("The actual error of HMD-GA almost equals that of centralised fusion.", "6.3, Fig. 7",
              ("kf-centralised/sample_trace_1", "kf-harmonic_mean/sample_trace_1"), _almost),
        Claim("The covariance that HMD-GA reports almost equals that of centralised fusion.", "6.3, Fig. 7",
              ("kf-centralised/reported_trace_1", "kf-harmonic_mean/reported_trace_1"), _almost),
    ),
    piece=2500,
    rules=RULE_CHOICES,
    scores=partial(shared.scores, READINGS[""]),
)  # fmt: skip
