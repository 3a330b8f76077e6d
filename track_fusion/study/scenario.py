"""What a scenario is, and what papers print and claim."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

from track_fusion.metrics.accuracy import Estimate
from track_fusion.study.chart import Chart
from track_fusion.study.claim import Claim
from track_fusion.study.rows import Outcomes, Progress
from track_fusion.study.rule_choice import RuleChoice, check_needs
from track_fusion.study.scene import Scene, Tracking
from track_fusion.tracks import TrackBatch


class Printed(float):
    """A published value by its print, where that ends in a zero, which a float forgets: Printed("10.70")."""

    def __new__(cls, text: str) -> Printed:
        """Read the print and keep it."""
        value = super().__new__(cls, text)
        value.text = text
        return value

    text: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scenario:
    """A published scenario.

    A study simulates Monte Carlo runs, joins their outcomes along the first axes, and makes figures, claims and charts
    of them; so runs can be worked on in pieces, by several processes, and kept.

    Attributes
    ----------
    key, title, paper          identification
    shows : str                what one learns from it
    published : mapping        figure name -> value as printed: Printed where the print ends in a zero
    chosen : tuple             those of its figures that agree because an assumption was chosen so
    published_runs : int       Monte Carlo runs behind the published figures
    default_runs : int         runs for a quick look; 1 where nothing is random
    publication_runs : int     runs for figures to be quoted
    assumptions : tuple        values and readings that the paper does not give
    simulate : callable        (runs, seed, progress, only) -> Outcomes of these run indices; `only` = beginning of the
                               names of the rows wanted; progress(done share). No run depends on the others
    figures : callable         Outcomes -> {figure name: Estimate}
    charts : callable          Outcomes -> list of Chart
    claims : tuple of Claim
    piece : int                so many runs are worked on at once
    tracking : Tracking | None what the ROS nodes run, one target; None = library only, unless there is a scene
    scene : callable | None    makes the Scene that the ROS nodes run, many targets
    judge : callable | None    (row, tracks that a centre published, a batch a fusion) -> Outcomes of one run, named as
                               those of `simulate`; None: one target, whose errors the evaluator node tells
    rules : tuple              the rules it compares, with their parameters
    given : tuple of str       extras that it has for rules that need more than the tracks
    scores : callable | None   (rules, runs, seed, progress) -> Outcomes, (R,) each, named as figures are: one number a
                               run, for any rules that `given` is enough for; None = the scenario fuses no tracks
    """

    key: str
    title: str
    paper: str
    shows: str
    simulate: Callable[[Sequence[int], int, Progress, str], Outcomes]
    figures: Callable[[Outcomes], dict[str, Estimate]]
    charts: Callable[[Outcomes], list[Chart]]
    published: Mapping[str, float] = dataclasses.field(default_factory=dict)
    chosen: tuple[str, ...] = ()
    published_runs: int = 1
    default_runs: int = 1
    publication_runs: int = 1
    assumptions: tuple[str, ...] = ()
    claims: tuple[Claim, ...] = ()
    piece: int = 100
    tracking: Tracking | None = None
    scene: Callable[[], Scene] | None = None
    judge: Callable[[str, Sequence[TrackBatch]], Outcomes] | None = None
    rules: tuple[RuleChoice, ...] = ()
    given: tuple[str, ...] = ()
    scores: Callable[[Sequence[RuleChoice], Sequence[int], int, Progress], Outcomes] | None = None

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
        played = self.tracking if self.scene is None else self.scene()
        assert played is not None
        return played

    @property
    def random(self) -> bool:
        """Whether more runs tell more."""
        return self.default_runs > 1

    def measure(
        self, runs: int, seed: int, progress: Progress = lambda share: None, only: str = ""
    ) -> dict[str, Estimate]:
        """Measure the figures whose names start with `only` over `runs` Monte Carlo runs, at once."""
        return self.figures(self.simulate(range(runs), seed, progress, only))

    def compare(self, rules: Sequence[RuleChoice], runs: Sequence[int], seed: int, progress: Progress) -> Outcomes:
        """Score any rules under the same noise, one number a run, (R,); only where there are `scores`.

        Raises
        ------
        ParameterError    a rule needs more than the tracks and what is `given`
        """
        check_needs(rules, self.given)
        assert self.scores is not None
        return self.scores(rules, runs, seed, progress)
