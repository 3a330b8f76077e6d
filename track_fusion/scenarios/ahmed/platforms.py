"""The target, the platforms and their filters of Ahmed 5.4, batched over Monte Carlo runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from track_fusion.densities.log_domain import log_of, normalised
from track_fusion.densities.mixture.mixture import Mixture, moments, stacked
from track_fusion.densities.mixture.reduction import prune, runnalls
from track_fusion.filters.gaussian_sum_modes import GaussianSumModes, MixtureModes
from track_fusion.filters.interacting_multiple_model import InteractingMultipleModel, Modes
from track_fusion.filters.iterated_corrector import IteratedCorrector
from track_fusion.linalg import Array
from track_fusion.models.measurement import RangeRangeRateSensor
from track_fusion.models.turn import KnownTurn, KnownTurnParams
from track_fusion.peers import Fuse, Peer, Schedule, communicate, ring
from track_fusion.random_streams import stream
from track_fusion.rules import SourceTracks
from track_fusion.study.rule_choice import RuleChoice
from track_fusion.trackers.fusion_loop import filtered
from track_fusion.tracks import StateLayout

LAYOUT = StateLayout(("x", "vx", "y", "vy"))
POSITION, VELOCITY = (0, 2), (1, 3)
STEPS, DT_S = 422, 1.0
TURN_RATES = (0.0, -0.05, 0.05, -0.15, 0.15)
MODES = len(TURN_RATES)
CHAIN = np.full((MODES, MODES), 0.0375) + (0.85 - 0.0375) * np.eye(MODES)
TRANSITIONS = tuple(
    KnownTurn(LAYOUT, KnownTurnParams(turn_rate=rate, process_noise=2.0)).over(DT_S) for rate in TURN_RATES
)
PLATFORMS = {"1": (0.0, -10e3), "2": (15e3, 10e3), "3": (-15e3, 10e3)}
SENSORS = {name: RangeRangeRateSensor(LAYOUT, 20.0, 1.0, place) for name, place in PLATFORMS.items()}
SCHEDULE = Schedule((ring(tuple(PLATFORMS)),), period=60)

START = np.array([5e3, 0.0, 1e2, 375.0])
START_SCATTER = np.array([500.0, 100.0, 500.0, 100.0])
START_VARIANCE = np.array([2000.0, 1000.0, 2000.0, 1000.0])
COMPONENTS = 12
#: Components below this share are "numerically indistinguishable from zero" and are dropped before merging.
NEGLIGIBLE = 1e-12

# What happens, and what the platforms see.


def truths(runs: Sequence[int], seed: int, steps: int = STEPS) -> Array:
    """Draw the target's states at steps 0 to T, (R, T + 1, 4): turn rates from the chain, the first one uniform."""
    states = np.empty((len(runs), steps + 1, LAYOUT.size))
    states[:, 0] = START
    for row, run in zip(states, runs, strict=True):
        rng = stream(seed, run, "truth")
        mode = int(rng.integers(MODES))
        for k in range(steps):
            transition, factor = TRANSITIONS[mode], TRANSITIONS[mode].noise_factor(row[k])
            row[k + 1] = transition.advance(row[k]) + factor @ rng.standard_normal(factor.shape[1])
            mode = int(np.searchsorted(np.cumsum(CHAIN[mode]), rng.random() * CHAIN[mode].sum(), side="right"))
    return states


def measurements(states: Array, runs: Sequence[int], seed: int) -> dict[str, Array]:
    """Draw ranges and range rates at steps 1 to T, (R, T, 2) for each platform."""
    seen = {}
    for name, sensor in SENSORS.items():
        draws = np.stack(
            [stream(seed, run, f"platform {name}").standard_normal((states.shape[1] - 1, 2)) for run in runs]
        )
        seen[name] = sensor.observe(states[:, 1:]) + draws * np.sqrt(np.diagonal(sensor.noise))
    return seen


def prior(runs: Sequence[int], seed: int) -> MixtureModes:
    """Twelve equal components for each mode about the true start, the same for all platforms, (R, 5, 12)."""
    shape = (MODES, COMPONENTS, LAYOUT.size)
    scatter = np.stack([stream(seed, run, "prior").standard_normal(shape) for run in runs]) * np.sqrt(START_SCATTER)
    lead = scatter.shape[:-1]
    weight, cov = np.full(lead, 1.0 / COMPONENTS), np.broadcast_to(np.diag(START_VARIANCE), (*lead, 4, 4))
    return MixtureModes(np.full((len(runs), MODES), 1.0 / MODES), Mixture(weight, START + scatter, cov))


# The filters.


def reduce(mixture: Mixture, count: int) -> Mixture:
    """Drop what has no weight, then merge by Runnalls."""
    return runnalls(prune(mixture, NEGLIGIBLE)[0], count)


#: Moves by the old mode, then jumps; at most 12 components a mode.
FILTER = GaussianSumModes(CHAIN, COMPONENTS, reduce)


def predict(modes: MixtureModes) -> MixtureModes:
    """Predict one step."""
    return FILTER.predict(modes, TRANSITIONS)


def update(modes: MixtureModes, z: Array, sensor: RangeRangeRateSensor) -> MixtureModes:
    """Condition on one platform's measurements (R, 2)."""
    return FILTER.update(modes, z, sensor)[0]


def fuse_modes(choice: RuleChoice, seed: int) -> Fuse[MixtureModes]:
    """Fuse mode by mode by a rule; the receiver's mode probabilities count the integrals, (74)-(76).

    A rule that knows no such integrals leaves the receiver's mode probabilities alone.
    """

    def fuse(own: MixtureModes, heard: MixtureModes, common: MixtureModes | None, count: int) -> MixtureModes:
        extras = {"seed": np.random.default_rng([seed, count])} if "seed" in choice.rule.optional else {}
        fused = choice.fuse(SourceTracks.of(stacked(own.mixture, heard.mixture), (), **extras))
        log_eta = fused.info.get("log_eta", np.zeros(own.probability.shape))
        return MixtureModes(normalised(log_of(own.probability) + log_eta), fused.density)

    return fuse


Platforms = dict[str, Peer[MixtureModes]]


def follow(
    platforms: Platforms, seen: Mapping[str, Array], steps: range, fuse: Fuse[MixtureModes] | None
) -> Iterator[tuple[Platforms, Platforms]]:
    """Yield the platforms at each of these steps, before and after they talk; without a way to fuse they never do."""
    for step in steps:
        platforms = {
            name: peer.moved(predict).updated(partial(update, z=seen[name][:, step - 1], sensor=SENSORS[name]))
            for name, peer in platforms.items()
        }
        before = platforms
        if fuse is not None:
            for sent in SCHEDULE.at(step):
                platforms = communicate(platforms, sent, fuse)
        yield before, platforms


def centralised(start: MixtureModes, seen: Mapping[str, Array], steps: int) -> Iterator[Modes]:
    """One Gaussian a mode, step by step, that has seen all three platforms' measurements."""
    one = IteratedCorrector(InteractingMultipleModel(CHAIN, jump_first=False))
    scans = ([seen[name][:, step] for name in SENSORS] for step in range(steps))
    modes = Modes(start.probability, *moments(start.mixture))
    return filtered(one, modes, TRANSITIONS, scans, list(SENSORS.values()))
