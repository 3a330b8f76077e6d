"""What a fusion centre is told before the first scan: its sources, motion, rule and thresholds, checked at once."""

from __future__ import annotations

import dataclasses
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from track_fusion.clock import ClockParams
from track_fusion.linalg import Array
from track_fusion.models.base import Motion
from track_fusion.models.transforms import Transform
from track_fusion.params import ParameterError, Params, param
from track_fusion.plugins import Registry
from track_fusion.random_streams import RandomParams
from track_fusion.rules import RULES, Rule, SourceTracks
from track_fusion.solvers.chi_square import chi_square_quantile
from track_fusion.tracks import SECOND_NS, StateLayout

#: Provenance has 32 bits.
MAX_SOURCES = 32
#: No clock is further off: 32 bits of seconds.
MAX_OFFSET_S = 2.0**32
#: Updates that a history remembers: its width in bits.
HISTORY_BITS = 32


#: What source tracks do not bring and a centre has all the same.
_AT_HAND = frozenset({"seed"})
#: The rules that a centre can run: all but those that need more than tracks, whatever their parameters.
TRACK_RULES: Registry[Rule] = Registry(
    RULES.group, "rule", Rule, {key: rule for key, rule in RULES.own.items() if not set(rule.needs) - _AT_HAND}
)


@dataclasses.dataclass(frozen=True)
class StateFusionParams(Params):
    """How tracks are fused."""

    state_fusion: str = param("covariance_intersection", "the fusion rule", choices=TRACK_RULES)


@dataclasses.dataclass(frozen=True)
class FusionCentreParams(Params):
    """What takes part in a fusion and how it is associated."""

    association: str = param(
        "nearest",
        "nearest: global nearest neighbour within the gates; single_target: all sources are known to track one and the "
        "same target, so that the first track of each is taken without a gate",
        choices=("nearest", "single_target"),
    )
    gate_probability: float = param(
        0.9999,
        "share of true pairs of tracks inside the gate (chi-square over all axes)",
        low=0.0,
        high=1.0 - 1e-12,
        strict=True,
    )
    keep_probability: float = param(
        1.0 - 1e-6,
        "the same for a source track and the central track that it fed last, if wider",
        low=0.0,
        high=1.0 - 1e-12,
        strict=True,
    )
    patience: int = param(
        5, "updates in a row that a source track beyond that gate is held out before it starts a track", low=0
    )
    merge_duplicates: str = param(
        "across_sources",
        "make one of two central tracks that stay together: where no source supports both, even where one does "
        "(a source that splits targets), or never",
        choices=("across_sources", "also_within_a_source", "off"),
    )
    max_scan_age_s: float = param(
        0.5, "a source's newest scan takes part, predicted, until it is older than this", unit="s", low=0.0
    )
    fuse_confirmed_only: bool = param(True, "leave tentative source tracks out")
    fuse_coasted: bool = param(True, "let coasted source tracks take part")
    memory: bool = param(
        False,
        "fuse the central track's own prediction, too, before the sources' tracks, and each scan only once; what is "
        "published stays conservative only by a rule that is so for every cross-correlation",
    )
    publish_tentative: bool = param(False, "publish central tracks before they are confirmed, too")
    particle_variances: tuple[float, ...] = param(
        (),
        "added to the variances of particles taken as one Gaussian, one number an axis, SI units squared: particles "
        "that have collapsed onto a few points have a singular covariance",
        low=0.0,
        kind=float,
    )


@dataclasses.dataclass(frozen=True)
class ScanBufferParams(Params):
    """When a fusion step runs and which scans are too late for it."""

    trigger: str = param(
        "any_source",
        "any_source: a scan makes a step, which waits gather_window_s for live sources that are due at its stamp; "
        "all_sources: a step waits until every live source has delivered a scan of its time or later; "
        "rate: a step at each tick of output_rate_hz",
        choices=("any_source", "all_sources", "rate"),
    )
    gather_window_s: float = param(
        0.004, "any_source: so long a step waits for sources that are due", unit="s", low=0.0
    )
    output_rate_hz: float = param(10.0, "rate: steps a second", unit="Hz", low=0.0, strict=True)
    max_output_rate_hz: float = param(
        0.0, "scans that come closer together than this allows are joined in one step; 0: no limit", unit="Hz", low=0.0
    )
    publish_at: str = param(
        "stamp",
        "stamp: tracks are published at the time of their step; now: they are predicted to the clock's time",
        choices=("stamp", "now"),
    )
    assembly_window_s: float = param(
        0.01,
        "a scan in pieces (Odometry) is complete so long after its last piece, unless all tracks of its source's last "
        "scan are there sooner; with all_sources: when its source's next scan begins",
        unit="s",
        low=0.0,
    )
    fusion_timeout_s: float = param(
        0.1, "how long a scan waits for the other sources, or for a step of a later time", unit="s", low=0.0
    )
    source_timeout_s: float = param(
        1.0,
        "after this silence a source is not waited for; when all are silent, tracks coast",
        unit="s",
        low=0.0,
        strict=True,
    )
    max_delay_s: float = param(10.0, "a scan older than this on arrival is rejected", unit="s", low=0.0, strict=True)
    out_of_sequence: str = param(
        "predict",
        "a scan that is no later than the last step: neglect it; predict it to the next one as its source's newest; or "
        "retrodict: repeat the steps since its stamp (needs memory: true)",
        choices=("neglect", "predict", "retrodict"),
    )
    history_length_s: float = param(
        2.0, "retrodict: how far back steps can be repeated; an older scan is kept out", unit="s", low=0.0, strict=True
    )
    history_megabytes: float = param(
        100.0, "retrodict: what is kept for that, about; the oldest steps are dropped", unit="MB", low=0.0, strict=True
    )
    max_rewind_share: float = param(
        0.3,
        "retrodict: share of the time that repeating may take; scans beyond it are predicted, and counted. 1: no limit",
        low=0.0,
        high=1.0,
        strict=True,
    )


@dataclasses.dataclass(frozen=True)
class TrackManagerParams(Params):
    """Thresholds of a central track's life, counted per update of a source."""

    confirmation_threshold: tuple[int, ...] = param(
        (2, 3), "[M, N]: confirm a track with M hits in the last N updates of one source", low=1, high=HISTORY_BITS
    )
    deletion_threshold: tuple[int, ...] = param(
        (5, 5),
        "[P, Q]: delete a track that every source that ever hit it missed in P of its last Q updates",
        low=1,
        high=HISTORY_BITS,
    )
    max_coast_s: float = param(
        0.0,
        "delete a track that no source supported for so long; 0: three periods of the slowest source that ever did, at "
        "least 5 s",
        unit="s",
        low=0.0,
    )
    confirmation_sources: int = param(1, "how many sources it takes to confirm a track, each by M of N", low=1)
    max_tentative_tracks: int = param(
        20_000, "keep at most so many tracks that are not confirmed; the oldest are dropped and counted", low=1
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("confirmation_threshold", "deletion_threshold"):
            value = getattr(self, name)
            if len(value) != 2 or value[0] > value[1]:
                raise ParameterError(f"The '{name}' parameter must be two integers, the first not larger. Got {value}.")


@dataclasses.dataclass(frozen=True)
class IdentityParams(Params):
    """What central tracks are called."""

    identity_namespace: str = param(
        "",
        "name from which the UUIDs of central tracks are made, ids counting from 1: the same in every run; empty: a "
        "namespace drawn at start, ids counting from a number made from the time, so that no restart gives one again",
    )


@dataclasses.dataclass(frozen=True)
class SourceSettings(Params):
    """What is declared of one source."""

    can_initiate: bool = param(True, "whether its tracks start central tracks")
    covariance_scale: float = param(
        1.0, "its covariances are multiplied by this (above 1: it claims too much)", low=0.0, high=1e6, strict=True
    )
    bias_sd: float = param(
        0.0,
        "standard deviation of its bias along each position axis, added to its covariances after scaling",
        unit="m",
        low=0.0,
        high=1e6,
    )
    time_offset_s: float = param(
        0.0, "added to its stamps: how far its clock is behind", unit="s", low=-MAX_OFFSET_S, high=MAX_OFFSET_S
    )
    max_tracks_per_scan: int = param(20_000, "a scan of more tracks is turned away whole (too_many_tracks)", low=1)
    is_self_reported: bool = param(
        True, "whether its tracks hold what it sensed itself and no more; false: they count as shared provenance"
    )

    @property
    def time_offset_ns(self) -> int:
        """The same in nanoseconds."""
        return round(self.time_offset_s * SECOND_NS)


@dataclasses.dataclass(frozen=True, eq=False)
class SourceConfig:
    """What is known of a source of tracks.

    Attributes
    ----------
    name : str
    assembles : bool               its scans arrive piece by piece (one message a track)
    transform : Transform or None  from its axes and frame to the centre's; None = it has those of the centre
    settings : SourceSettings
    """

    name: str
    assembles: bool = False
    transform: Transform | None = None
    settings: SourceSettings = SourceSettings()


@dataclasses.dataclass(frozen=True, eq=False)
class CentreConfig:
    """A fusion centre of S sources, all but its state.

    Attributes
    ----------
    sources : tuple of SourceConfig    in the order in which a rule gets their tracks; scans name them by index
    motion : Motion                    predicts source and central tracks; its layout is the centre's, n axes
    frame_id : str                     frame of the central tracks
    rule : Rule                        one that needs only tracks
    rule_params : Params               of that rule
    params : FusionCentreParams
    manager : TrackManagerParams
    buffer : ScanBufferParams
    random : RandomParams              what rules that sample draw from, step after step
    identity : IdentityParams
    clock : ClockParams                how far the clocks may be trusted

    Raises
    ------
    ParameterError    too many sources; the rule needs what source tracks do not bring, such as their
                      cross-covariance; `confirmation_sources` exceeds them; weights are given that do not fit the
                      sources; not one number an axis in `particle_variances`; retrodiction without memory; a transform
                      does not bring every axis of the centre
    """

    sources: tuple[SourceConfig, ...]
    motion: Motion
    frame_id: str
    rule: Rule
    rule_params: Params
    params: FusionCentreParams = FusionCentreParams()
    manager: TrackManagerParams = TrackManagerParams()
    buffer: ScanBufferParams = ScanBufferParams()
    random: RandomParams = RandomParams(role="fusion_centre")
    identity: IdentityParams = IdentityParams()
    clock: ClockParams = ClockParams()

    def __post_init__(self) -> None:
        if len(self.sources) > MAX_SOURCES:
            raise ParameterError(f"The 'sources' must be at most {MAX_SOURCES}. Got {len(self.sources)}.")
        if self.manager.confirmation_sources > max(len(self.sources), 1):
            raise ParameterError(
                f"The 'confirmation_sources' parameter must be at most {len(self.sources)}, the number of sources. "
                f"Got {self.manager.confirmation_sources}."
            )
        needed = sorted(set(self.rule.needed(self.rule_params)) - _AT_HAND)
        if needed:
            raise ParameterError(
                f"The 'state_fusion' parameter must be a rule that needs only tracks. Got '{self.rule.key}', "
                f"which at these parameters needs {', '.join(needed)}: use it in the library or by track-fusion fuse."
            )
        if len(self.params.particle_variances) not in (0, self.layout.size):
            raise ParameterError(
                f"The 'particle_variances' parameter must hold {self.layout.size} numbers, one an axis, or none. "
                f"Got {len(self.params.particle_variances)}."
            )
        if self.retrodicts and not self.params.memory:
            raise ParameterError(
                "The 'out_of_sequence' parameter must be 'neglect' or 'predict' where 'memory' is false: each source's "
                "newest scan alone counts then, so that a late one would change nothing but the past. Got 'retrodict'."
            )
        if len(self.weights) or getattr(self.rule_params, "criterion", "") == "given":
            self._try_weights()
        for source in self.sources:
            self._check_transform(source)

    def _try_weights(self) -> None:
        """Refuse weights that the rule would refuse when every source has a track: see it on equal ones."""
        count, n = len(self.sources) + self.params.memory, self.layout.size
        if count == 1:
            return
        equal = SourceTracks(np.zeros((1, count, n)), np.tile(np.eye(n), (1, count, 1, 1)))
        try:
            self.rule.fuse(equal, self.rule_params)
        except ValueError as error:
            what = "one a source, the central track first" if self.params.memory else "one a source"
            raise ParameterError(
                f"The parameters of the rule '{self.rule.key}' do not fit {count} tracks, {what}: {error}"
            ) from None

    def _check_transform(self, source: SourceConfig) -> None:
        if source.transform is None:
            return
        shape, rank = source.transform.matrix.shape, int(np.linalg.matrix_rank(source.transform.matrix))
        if shape[0] != self.layout.size or rank < self.layout.size:
            raise ParameterError(
                f"The 'transform' of the source '{source.name}' must bring every axis of the centre, "
                f"{', '.join(self.layout.axes)}. Got a matrix of shape {shape} and rank {rank}."
            )

    @property
    def layout(self) -> StateLayout:
        """The n axes of the central tracks."""
        return self.motion.layout

    @cached_property
    def gamma(self) -> float:
        """The gate: a quantile of chi-square with n degrees of freedom."""
        return chi_square_quantile(self.params.gate_probability, self.layout.size)

    @cached_property
    def keep_gamma(self) -> float:
        """The gate of linked tracks, not narrower than the other."""
        return max(self.gamma, chi_square_quantile(self.params.keep_probability, self.layout.size))

    @cached_property
    def floor(self) -> Array:
        """What is added to the covariance of particles, (n, n)."""
        return np.diag(self.params.particle_variances or np.zeros(self.layout.size))

    @cached_property
    def weights(self) -> Array:
        """Fusion weights given to the rule, the central track's first with memory; empty: it finds its own."""
        return np.array(getattr(self.rule_params, "weights", ()), float)

    @cached_property
    def brings(self) -> NDArray[np.bool_]:
        """Which axes of the centre each source brings, (S, n)."""
        every = np.ones(self.layout.size, bool)
        rows = [every if s.transform is None else s.transform.brings for s in self.sources]
        return np.array(rows, bool).reshape(-1, self.layout.size)

    @property
    def joins_scans(self) -> bool:
        """Whether a step may take up scans of stamps before its own."""
        return self.buffer.trigger == "rate" or self.buffer.max_output_rate_hz > 0

    @property
    def retrodicts(self) -> bool:
        """Whether a late scan makes the centre repeat its last steps."""
        return self.buffer.out_of_sequence == "retrodict"

    @cached_property
    def can_initiate(self) -> NDArray[np.bool_]:
        """Which sources start central tracks, (S,)."""
        return np.array([source.settings.can_initiate for source in self.sources], bool)

    @cached_property
    def draws(self) -> bool:
        """Whether the rule draws random numbers."""
        return "seed" in (*self.rule.needed(self.rule_params), *self.rule.optional)
