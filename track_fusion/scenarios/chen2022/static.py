"""Chen and Zhou 2022, section 5.1: how near fusion comes to the informative barycenter of two estimates."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial

import numpy as np
from scipy.optimize import minimize_scalar

from track_fusion.densities.elliptical.elliptical import Family, generalized_gaussian, student_t
from track_fusion.densities.elliptical.rao import informative_barycenter, rao_distance_scalar, scalar_geodesic
from track_fusion.linalg import Array
from track_fusion.metrics.accuracy import Estimate
from track_fusion.rules import SourceTracks
from track_fusion.rules.shared.elliptical import EllipticalParams
from track_fusion.scenarios.chen2022 import PAPER
from track_fusion.scenarios.chen2022.choices import DCI, FCI, GP, KLA, MHDP_E, MHDP_I, QMMHD, UNSQUARED
from track_fusion.study.chart import Chart, Series
from track_fusion.study.claim import Claim, within
from track_fusion.study.rows import Outcomes, Progress, exact_rows
from track_fusion.study.rule_choice import RuleChoice, rule_by_rule
from track_fusion.study.scenario import Scenario

#: The local estimates of 5.1: means, and scatters (scalar: the squares of scale parameters).
MEANS, SCATTERS = np.array([2.0, 4.0]), np.array([5.0, 7.0])


@dataclasses.dataclass(frozen=True)
class Setting:
    """One subfigure of Fig. 2: the family to which both estimates belong, by its dof or its beta."""

    title: str
    dof: float | None = None
    beta: float = 1.0

    @property
    def family(self) -> Family:
        """The family, of one axis."""
        return generalized_gaussian(self.beta, 1) if self.dof is None else student_t(self.dof, 1)

    @property
    def tracks(self) -> SourceTracks:
        """The estimates as a rule gets them: covariances are kappa times the scatters."""
        dof = None if self.dof is None else np.full(2, self.dof)
        return SourceTracks(MEANS[:, None], (self.family.kappa * SCATTERS)[:, None, None], dof)

    @property
    def barycenter(self) -> tuple[Array, Array]:
        """Informative barycenter: mean and scatter of the midpoint of the geodesic."""
        return informative_barycenter(self.family, MEANS, SCATTERS)

    def geodesic(self, fraction: Array | float) -> tuple[Array, Array]:
        """Mean and scatter of points of the geodesic between the estimates."""
        return scalar_geodesic(self.family, MEANS[0], SCATTERS[0], MEANS[1], SCATTERS[1], fraction)

    def fuse(self, choice: RuleChoice) -> Array:
        """Fuse by a rule, which is told the family unless it takes the tracks for Gaussian: mean and scatter, (2,)."""
        params = choice.params
        if isinstance(params, EllipticalParams) and params.family != "gaussian" and self.dof is None:
            params = dataclasses.replace(params, family="generalized_gaussian", beta=self.beta)
        fused = choice.rule.apply(self.tracks, params)
        return np.array([fused.mean[0], fused.cov[0, 0] / self.family.kappa])

    def from_barycenter(self, fused: Array) -> float:
        """Rao distance of a fused density, (mean, scatter), from the barycenter."""
        return float(rao_distance_scalar(self.family, *self.barycenter, fused[0], fused[1]))

    def from_geodesic(self, fused: Array) -> float:
        """Rao distance of a fused density, (mean, scatter), from the nearest point of the geodesic."""

        def distance(fraction: float) -> float:
            return float(rao_distance_scalar(self.family, *self.geodesic(fraction), fused[0], fused[1]))

        return float(minimize_scalar(distance, bounds=(0.0, 1.0), method="bounded", options={"xatol": 1e-9}).fun)


#: Fig. 2 (a)-(f).
SETTINGS = {
    "t3": Setting("t(3)", dof=3.0),
    "t5": Setting("t(5)", dof=5.0),
    "t7": Setting("t(7)", dof=7.0),
    "gg065": Setting("GG(0.65)", beta=0.65),
    "gg085": Setting("GG(0.85)", beta=0.85),
    "gg1": Setting("GG(1)", beta=1.0),
}
#: Those of which the plane of means and scatters is drawn.
DRAWN = ("t3", "gg1")

OTHERS = (DCI, FCI, KLA, GP, QMMHD)
RULE_CHOICES = (*OTHERS, MHDP_E, MHDP_I, UNSQUARED)


def row_name(choice: RuleChoice, setting: str) -> str:
    """Name a row: given-rule@family or given-rule@family_variant."""
    return f"given-{choice.key}@{setting}" + (f"_{choice.variant}" if choice.variant else "")


ROWS = {row_name(choice, name): (choice, setting) for name, setting in SETTINGS.items() for choice in RULE_CHOICES}


def fused(choice: RuleChoice, setting: Setting) -> dict[str, Array]:
    """Fuse one row: mean and scatter, (2,); nothing is random."""
    return {"fused": setting.fuse(choice)}


def figures(outcomes: Outcomes) -> dict[str, Estimate]:
    """Rao distances from the barycenter and from the geodesic, names like given-mhdp_explicit@t3/rao_distance_1."""
    measured = {}
    for name, fused in outcomes.items():
        row = name.removesuffix("/fused")
        setting = ROWS[row][1]
        measured[f"{row}/rao_distance_1"] = Estimate.exact(setting.from_barycenter(fused[0]))
        measured[f"{row}/geodesic_distance_1"] = Estimate.exact(setting.from_geodesic(fused[0]))
    return measured


def scores(rules: Sequence[RuleChoice], runs: Sequence[int], seed: int, progress: Progress) -> Outcomes:
    """Rao distance from the barycenter under any rules, a quantity a family; nothing is random."""

    def measure(choice: RuleChoice) -> Outcomes:
        distances = {name: setting.from_barycenter(setting.fuse(choice)) for name, setting in SETTINGS.items()}
        return {f"rao_distance_{name}_1": np.full(len(runs), value) for name, value in distances.items()}

    return rule_by_rule("given", rules, progress, measure)


def charts(outcomes: Outcomes) -> list[Chart]:
    """Distances from the barycenter by family, and the plane of means and scatters for two of them."""
    measured, places, bars = figures(outcomes), np.arange(len(SETTINGS), dtype=float), []
    for choice in RULE_CHOICES:
        if choice.key == MHDP_I.key:
            continue  # in one axis it is MHDP-E
        names = [f"{row_name(choice, name)}/rao_distance_1" for name in SETTINGS]
        values = [measured[name].value if name in measured else np.nan for name in names]
        if not np.isnan(values).all():
            bars.append(Series(choice.name, places, np.array(values), "bars"))
    ticks = dict(zip(places.tolist(), (setting.title for setting in SETTINGS.values()), strict=True))
    title = "Rao distance of the fused density from the informative barycenter"
    planes = [_plane(s, outcomes) for s in DRAWN if any(f"{row_name(c, s)}/fused" in outcomes for c in RULE_CHOICES)]
    return [Chart(title, "family of both estimates", "Rao distance", tuple(bars), ticks=ticks), *planes]


def _plane(name: str, outcomes: Outcomes) -> Chart:
    """Draw where the rules put the fused density, between the geodesic and the chord."""
    setting = SETTINGS[name]
    (means, scatters), centre = setting.geodesic(np.linspace(0.0, 1.0, 101)), np.array(setting.barycenter)
    lines = [
        Series("geodesic", means, scatters),
        Series("intersections at any weight", MEANS, SCATTERS, "dashed"),
        Series("informative barycenter", centre[:1], centre[1:], "points"),
    ]
    for choice in (*OTHERS, MHDP_E):
        fused = outcomes.get(f"{row_name(choice, name)}/fused")
        if fused is not None:
            lines.append(Series(choice.name, fused[:1, 0], fused[:1, 1], "points"))
    return Chart(f"{setting.title}: fused densities", "mean", "scatter", tuple(lines))


def _nearest(
    text: str, settings: Sequence[str], mhdp: RuleChoice, quantity: str, others: Sequence[RuleChoice] = OTHERS
) -> Claim:
    """Claim that MHDP is nearer than every other rule in each of these families."""
    needs = tuple(f"{row_name(choice, name)}/{quantity}" for name in settings for choice in (mhdp, *others))

    def margins(*distances: Array) -> list[Array]:
        groups = (distances[i : i + 1 + len(others)] for i in range(0, len(distances), 1 + len(others)))
        return [other - first for first, *rest in groups for other in rest]

    return Claim(text, "5.1, Fig. 2", needs, margins)


STUDENT, GENERALIZED = tuple(SETTINGS)[:3], tuple(SETTINGS)[3:]
CLAIMS = (
    _nearest("t densities: MHDP-E, by squared distances, is nearest to the informative barycenter whatever the dof",
             STUDENT, MHDP_E, "rao_distance_1"),
    _nearest("generalised Gaussians: MHDP-E, by squared distances, is nearest to the informative barycenter whatever "
             "the shape", GENERALIZED, MHDP_E, "rao_distance_1"),
    _nearest("t densities: MHDP-E, by the distances as printed, is nearest to the informative barycenter whatever the "
             "dof", STUDENT, UNSQUARED, "rao_distance_1"),
    _nearest("generalised Gaussians: MHDP-E, by the distances as printed, is nearest to the informative barycenter "
             "whatever the shape", GENERALIZED, UNSQUARED, "rao_distance_1"),
    _nearest("all families: MHDP-E, by squared distances, is nearer to the geodesic than FCI, KLA, GP, QMMHD (DCI is "
             "an end of it)", tuple(SETTINGS), MHDP_E, "geodesic_distance_1", OTHERS[1:]),
    Claim(
        "MHDP-I and MHDP-E fuse to the same density", "5.1",
        tuple(f"{row_name(choice, name)}/rao_distance_1" for name in SETTINGS for choice in (MHDP_E, MHDP_I)),
        lambda *pairs: [m for a, b in zip(pairs[::2], pairs[1::2], strict=True) for m in within(a - b, 1e-9)],
    ),
)  # fmt: skip

SCENARIO = Scenario(
    key="chen2022-static",
    title="Two estimates of a number from one heavy-tailed family",
    paper=f"{PAPER}, 5.1",
    shows="how near each rule comes to the midpoint of the geodesic between two densities, at six weights of the tails",
    assumptions=(
        "5 and 7 are scatters; rules for Gaussians see kappa times them, and what is fused is divided by kappa",
        "GP takes the tracks for Gaussian; FCI is the exact half-way point; DCI minimises the determinant, KLA weighs "
        "equally; QMMHD, whose equations are in another paper, is the intersection at the weights with the least sum "
        "of squared minimal Manhattan distances",
        "MHDP minimises the sum of squared distances; @unsquared: that of the distances, as printed, which makes one "
        "sensor's estimate the fused mean",
    ),
    simulate=partial(exact_rows, {name: partial(fused, *row) for name, row in ROWS.items()}),
    figures=figures,
    charts=charts,
    claims=CLAIMS,
    rules=RULE_CHOICES,
    scores=scores,
)
