"""What a scenario is, and what scenarios share."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Protocol, TypeVar

import numpy as np

from track_fusion.linalg import Array, matvec, transpose
from track_fusion.metrics.accuracy import Estimate
from track_fusion.models.base import Motion, Sensor
from track_fusion.models.noise import Noise
from track_fusion.params import ParameterError, Params, unknown_name_error
from track_fusion.rules import RULES, FusedTracks, Rule, SourceTracks
from track_fusion.study.chart import Chart
from track_fusion.tracks import StateLayout, TrackBatch

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Tracking:
    """One target, sensors and a centre: what the library's study and the ROS nodes are both driven by.

    Attributes
    ----------
    motion : Motion    of the truth and of the filters; its layout is the scenario's
    dt_s, steps                        sampling interval in seconds, number of filtering steps
    initial_mean (n,), initial_cov (n, n)    of every filter
    sensors : mapping name -> Sensor
    process_noise, measurement_noise : Noise    of the truth and of the measurements, in units of the motion's and the
                                                sensors' own, which are what the filters are told
    initial_noise : Noise | None                of the truth's first state, in units of initial_cov; None = it is the
                                                initial mean itself
    """

    motion: Motion
    dt_s: float
    steps: int
    initial_mean: Array
    initial_cov: Array
    sensors: Mapping[str, Sensor]
    process_noise: Noise = Noise()
    measurement_noise: Noise = Noise()
    initial_noise: Noise | None = None

    def truth(self, seed: int, run: int, steps: int | None = None) -> Array:
        """Draw the target's states at steps 0 to T, (T + 1, n).

        T is `steps`, the scenario's own number by default; the first states do not depend on it.
        """
        states: Array = self.truths(seed, [run], steps)[0]
        return states

    def truths(self, seed: int, runs: Sequence[int], steps: int | None = None) -> Array:
        """Draw the target's states of several runs, (R, T + 1, n)."""
        steps = self.steps if steps is None else steps
        transition = self.motion.over(self.dt_s)
        size = transition.noise_factor(self.initial_mean).shape[-1]
        draws = np.stack([self.process_noise.draw(seed, run, "truth", steps, size) for run in runs])
        states = np.empty((len(runs), steps + 1, len(self.initial_mean)))
        states[:, 0] = [self._initial(seed, run) for run in runs]
        for k in range(steps):
            # One matrix a run: products of larger ones round differently with the number of runs.
            moved, factor = transition.advance(states[:, k, None])[:, 0], transition.noise_factor(states[:, k])
            states[:, k + 1] = moved + matvec(factor, draws[:, k])
        return states

    def _initial(self, seed: int, run: int) -> Array:
        if self.initial_noise is None:
            return self.initial_mean
        draw = self.initial_noise.draw(seed, run, "initial state", 1, len(self.initial_mean))[0]
        return np.asarray(self.initial_mean + np.linalg.cholesky(self.initial_cov) @ draw)

    def measurements(self, truth: Array, seed: int, run: int) -> dict[str, Array]:
        """Draw each sensor's measurements at steps 1 to T, (T, m) each."""
        found = {}
        for name, sensor in self.sensors.items():
            factor = np.linalg.cholesky(sensor.noise)
            draws = self.measurement_noise.draw(seed, run, name, len(truth) - 1, len(factor))
            z = sensor.observe(truth[1:]) + draws @ factor.T
            found[name] = sensor.residual(z, np.zeros_like(z))  # angles wrapped
        return found


class Scene(Protocol):
    """Any number of targets, and sensors that miss and invent: what the replay node publishes scan by scan."""

    @property
    def layout(self) -> StateLayout:
        """Axes of the true states, n."""

    @property
    def dt_s(self) -> float:
        """Seconds from scan to scan, the same for all sensors."""

    @property
    def steps(self) -> int:
        """Number of scans of a whole run, the first one `dt_s` after the start."""

    @property
    def sensors(self) -> Mapping[str, Sensor]:
        """Sensors by name."""

    def truth(self, seed: int, run: int, steps: int | None = None) -> Array:
        """Return the states at steps 0 to T, (T + 1, N, n), NaN where a target does not exist.

        T is `steps`, the scene's own number by default; the first states do not depend on it.
        """

    def detections(self, seed: int, run: int, steps: int | None = None) -> dict[str, list[Array]]:
        """Draw each sensor's scans 1 to T, (D_k, m) each; the first scans do not depend on T."""


@dataclasses.dataclass(frozen=True)
class OneTarget:
    """The Scene of a Tracking: one target, seen by every sensor at every step."""

    tracking: Tracking

    @property
    def layout(self) -> StateLayout:
        """Axes of the true states."""
        return self.tracking.motion.layout

    @property
    def dt_s(self) -> float:
        """Sampling interval."""
        return self.tracking.dt_s

    @property
    def steps(self) -> int:
        """Number of filtering steps."""
        return self.tracking.steps

    @property
    def sensors(self) -> Mapping[str, Sensor]:
        """Sensors by name."""
        return self.tracking.sensors

    def truth(self, seed: int, run: int, steps: int | None = None) -> Array:
        """Draw the states, (T + 1, 1, n)."""
        return self.tracking.truth(seed, run, steps)[:, None]

    def detections(self, seed: int, run: int, steps: int | None = None) -> dict[str, list[Array]]:
        """Draw each sensor's measurements, one a scan, (1, m) each."""
        drawn = self.tracking.measurements(self.tracking.truth(seed, run, steps), seed, run)
        return {name: list(z[:, None]) for name, z in drawn.items()}


@dataclasses.dataclass(frozen=True)
class RuleChoice:
    """A rule with the parameters that a scenario gives it, and the name of the variant ("" = the paper's)."""

    key: str
    params: Params
    variant: str = ""

    @property
    def name(self) -> str:
        """`key` or `key@variant`."""
        return f"{self.key}@{self.variant}" if self.variant else self.key


#: Measurements of R Monte Carlo runs by name, (R, ...) each: what runs are joined by.
Samples = dict[str, Array]
Progress = Callable[[float], None]


class Printed(float):
    """A published value by its print, where that ends in a zero, which a float forgets: Printed("10.70")."""

    def __new__(cls, text: str) -> Printed:
        """Read the print and keep it."""
        value = super().__new__(cls, text)
        value.text = text
        return value

    text: str


@dataclasses.dataclass(frozen=True)
class Claim:
    """Something a paper claims that is no single figure, and how it is judged.

    Attributes
    ----------
    text, source : str      the claim in our words; where it stands
    needs : tuple of str    names of the figures that decide it
    holds : callable        their Estimates, in this order -> whether the claim is true of them
    """

    text: str
    source: str
    needs: tuple[str, ...]
    holds: Callable[..., bool]

    @classmethod
    def order(cls, text: str, source: str, *needs: str) -> Claim:
        """Claim that the figures ascend strictly."""

        def holds(*estimates: Estimate) -> bool:
            values = [e.value for e in estimates]
            return all(a < b for a, b in zip(values, values[1:], strict=False))

        return cls(text, source, needs, holds)

    @classmethod
    def least(cls, text: str, source: str, figure: str, others: Sequence[str]) -> Claim:
        """Claim that a figure is less than each of some others."""
        return cls(text, source, (figure, *others), lambda first, *rest: all(first.value < e.value for e in rest))

    @classmethod
    def greatest(cls, text: str, source: str, figure: str, others: Sequence[str], times: float = 1.0) -> Claim:
        """Claim that a figure exceeds so many times each of some others."""

        def holds(first: Estimate, *rest: Estimate) -> bool:
            return all(first.value > times * e.value for e in rest)

        return cls(text, source, (figure, *others), holds)


@dataclasses.dataclass(frozen=True)
class Scenario:
    """A published scenario.

    A study draws Monte Carlo runs (`sample`), joins them along their first axes, and makes figures, claims and charts
    of them; so runs can be worked on in pieces, by several processes, and kept.

    Attributes
    ----------
    key, title, paper          identification
    shows : str                what one learns from it
    published : mapping        figure name -> value as printed: Printed where the print ends in a zero
    published_runs : int       Monte Carlo runs behind the published figures
    default_runs : int         runs for a quick look; 1 where nothing is random
    publication_runs : int     runs for figures to be quoted
    assumptions : tuple        values and readings that the paper does not give
    sample : callable          (runs, seed, progress, only) -> Samples of these run indices; `only` = beginning of the
                               names of the rows wanted; progress(done share). No run depends on the others
    figures : callable         Samples -> {figure name: Estimate}
    charts : callable          Samples -> list of Chart
    claims : tuple of Claim
    piece : int                so many runs are worked on at once
    tracking : Tracking | None what the ROS nodes run, one target; None = library only, unless there is a scene
    scene : callable | None    makes the Scene that the ROS nodes run, many targets
    judge : callable | None    (row, tracks that a centre published, a batch a fusion) -> Samples of one run, named as
                               those of `sample`; None: one target, whose errors the evaluator node tells
    rules : tuple              the rules it compares, with their parameters
    compare : callable | None  (rules, runs, seed, progress) -> Samples, (R,) each, named as figures are: one number a
                               run for any rules; None = the scenario fuses no tracks
    """

    key: str
    title: str
    paper: str
    shows: str
    published: Mapping[str, float]
    published_runs: int
    default_runs: int
    publication_runs: int
    assumptions: tuple[str, ...]
    sample: Callable[[Sequence[int], int, Progress, str], Samples]
    figures: Callable[[Samples], dict[str, Estimate]]
    charts: Callable[[Samples], list[Chart]]
    claims: tuple[Claim, ...] = ()
    piece: int = 100
    tracking: Tracking | None = None
    scene: Callable[[], Scene] | None = None
    judge: Callable[[str, Sequence[TrackBatch]], Samples] | None = None
    rules: tuple[RuleChoice, ...] = ()
    compare: Callable[[Sequence[RuleChoice], Sequence[int], int, Progress], Samples] | None = None

    @property
    def over_ros(self) -> bool:
        """Whether there is something for the ROS nodes to run."""
        return self.tracking is not None or self.scene is not None

    def played(self) -> Scene:
        """Make what the replay node publishes; only where :attr:`over_ros`.

        Raises
        ------
        ImportError    a package that the scene is made with is missing
        """
        if self.scene is not None:
            return self.scene()
        assert self.tracking is not None
        return OneTarget(self.tracking)

    @property
    def random(self) -> bool:
        """Whether more runs tell more."""
        return self.default_runs > 1

    def study(
        self, runs: int, seed: int, progress: Progress = lambda share: None, only: str = ""
    ) -> dict[str, Estimate]:
        """Measure the figures whose names start with `only` over `runs` Monte Carlo runs, at once."""
        return self.figures(self.sample(range(runs), seed, progress, only))


def fuse_runs(
    rule: Rule,
    params: Params,
    mean: Array,
    cov: Array,
    rngs: Sequence[np.random.Generator] | None = None,
    dof: float = math.inf,
) -> FusedTracks:
    """Fuse the tracks of R runs, covariances that all runs share only once.

    Parameters
    ----------
    mean : (R, K, n)
    cov : (R, K, n, n), or (1, K, n, n) where all runs have the same
    rngs : one generator a run, or None    for a rule that samples: each run then draws its own numbers
    dof : float    degrees of freedom of every track

    Returns
    -------
    FusedTracks    mean (R, n), cov (R, n, n) or (1, n, n), weights (R, K), (1, K) or None

    Notes    A linear rule gives sum of A_i x_i; fusing unit vectors gives its matrices A_i.
    """
    runs, count, n = mean.shape
    if len(cov) < runs and rule.linear:
        units = np.eye(count * n).reshape(-1, count, n)
        fused = rule.fuse(SourceTracks(units, np.repeat(cov, len(units), 0)), params)
        weights = None if fused.weights is None else fused.weights[:1]
        return FusedTracks(matvec(transpose(fused.mean), mean.reshape(runs, -1)), fused.cov[:1], weights)
    dofs = np.full((runs, count), dof) if math.isfinite(dof) else None
    tracks = SourceTracks(mean, np.broadcast_to(cov, (runs, count, n, n)), dofs)
    if rngs is None or not rule.uses("seed", params):
        return rule.fuse(tracks, params)
    each = [rule.fuse(_one_run(tracks, r, rng), params) for r, rng in enumerate(rngs)]
    weighed = [f.weights for f in each if f.weights is not None]
    weights = np.concatenate(weighed) if weighed else None
    return FusedTracks(np.concatenate([f.mean for f in each]), np.concatenate([f.cov for f in each]), weights)


def _one_run(tracks: SourceTracks, run: int, rng: np.random.Generator) -> SourceTracks:
    at = slice(run, run + 1)
    dof = None if tracks.dof is None else tracks.dof[at]
    return SourceTracks(tracks.mean[at], tracks.cov[at], dof, extras={"seed": rng})


def check_needs(choices: Sequence[RuleChoice], given: Collection[str] = ()) -> None:
    """Check that rules can do with the tracks and the extras that a scenario gives.

    Raises
    ------
    ParameterError    a rule needs something else
    """
    for choice in choices:
        missing = [name for name in RULES[choice.key].needed(choice.params) if name not in given]
        if missing:
            raise ParameterError(
                f"The 'rules' parameter must be rules for which this scenario has all they need. Got {choice.name!r}, "
                f"which needs {missing[0]!r} beside the tracks."
            )


def compare_each(
    name: str,
    rules: Sequence[RuleChoice],
    progress: Progress,
    measure: Callable[[RuleChoice], Mapping[str, Array]],
    given: Collection[str] = (),
) -> Samples:
    """Measure any rules one after the other: what many scenarios' `compare` is.

    Parameters
    ----------
    name : str            of the filter, the beginning of the figures' names
    measure : callable    rule -> {quantity and unit: (R,)}
    given                 extras that the scenario has for rules that need them

    Raises
    ------
    ParameterError    a rule needs something else
    """
    check_needs(rules, given)
    found: Samples = {}
    for done, choice in enumerate(rules):
        found |= {f"{name}-{choice.name}/{quantity}": values for quantity, values in measure(choice).items()}
        progress((done + 1) / len(rules))
    return found


def chosen(rows: Mapping[str, T], only: str) -> dict[str, T]:
    """Return the rows whose names start with `only`.

    Raises
    ------
    ParameterError    there is none; the message lists the rows
    """
    found = {name: row for name, row in rows.items() if name.startswith(only)}
    if not found:
        raise unknown_name_error(only, rows, "row")
    return found
