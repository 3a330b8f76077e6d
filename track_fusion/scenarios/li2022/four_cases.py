"""Li et al., AA density fusion, Fig. 1: every rule on two Gaussian tracks, from near to far apart."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np

from track_fusion.densities.mixture.mixture import Mixture, log_pdf
from track_fusion.linalg import Array
from track_fusion.metrics.accuracy import Estimate
from track_fusion.random_streams import stream
from track_fusion.rules import RULES, FusedTracks, Rule, SourceTracks
from track_fusion.scenarios.li2022 import PAPER
from track_fusion.study.chart import Chart, ellipse
from track_fusion.study.claim import Claim, Margins, ascending
from track_fusion.study.rows import Outcomes, Progress, chosen, row_by_row
from track_fusion.study.rule_choice import RuleChoice, rule_by_rule
from track_fusion.study.scenario import Scenario

#: The densities of Fig. 1 are not printed. This pair is assumed: trace-optimal covariance intersection gives it the
#: paper's weight w1 = .3764.
COVS = np.array([[[4.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, 2.4163]]])
#: Case -> distance of the means along x, and twice that along y, from near to far.
SEPARATIONS = {"a": 0.5, "b": 2.0, "c": 4.5, "d": 8.0}
#: Section II-E: the weight of covariance intersection, which does not depend on the means.
SECTION_2E = {f"given-covariance_intersection/weight_case_{case}_1": 0.3764 for case in SEPARATIONS}

#: The schemes of Fig. 1.
SCHEMES = (
    RuleChoice.of("naive"),
    RuleChoice.of("geometric_average"),
    RuleChoice.of("covariance_intersection", criterion="trace"),
    RuleChoice.of("arithmetic_average", criterion="uniform"),
    RuleChoice.of("covariance_union", "min_trace", bound="min_trace"),
    RuleChoice.of("covariance_union", "max_trace", bound="max_trace"),
)
#: Rules that chain (19) adds, by the trace as all of it, and the covariance that bounds both tracks.
CHAIN = (
    RuleChoice.of("inverse_covariance_intersection", criterion="trace"),
    RuleChoice.of("fault_tolerant_covariance_intersection", criterion="trace"),
    RuleChoice.of("covariance_union", criterion="trace"),
)


def enough_for_two() -> list[Rule]:
    """Rules that two tracks are enough for, in the order of the registry."""
    return [rule for rule in RULES.own.values() if not rule.needed(rule.params())]


_NAMED = {choice.key for choice in (*SCHEMES, *CHAIN)}
#: All other rules, as they are by default.
OTHERS = tuple(RuleChoice.of(rule.key) for rule in enough_for_two() if rule.key not in _NAMED)
RULE_CHOICES = (*SCHEMES, *CHAIN, *OTHERS)
#: Traces that are equal may differ by rounding, relative.
ROUNDING = 1e-9
#: Ellipses of so many other rules in one picture.
IN_A_PICTURE = 6
#: The tracks themselves, and the mixture that the arithmetic average is before it is merged.
TRACKS, MIXTURE = ("given-alone@track_1", "given-alone@track_2"), "given-arithmetic_average@mixture"
ROWS: dict[str, RuleChoice | None] = {
    **dict.fromkeys(TRACKS),
    **{f"given-{choice.name}": choice for choice in RULE_CHOICES},
    MIXTURE: RuleChoice.of("arithmetic_average", criterion="uniform", output="mixture"),
}


def two_tracks(separation: float) -> SourceTracks:
    """Make the pair with its means so far apart."""
    return SourceTracks(np.array([[0.0, 0.0], [separation, 0.5 * separation]]), COVS)


def all_cases() -> SourceTracks:
    """The pair in all cases, (4, 2, ...)."""
    pairs = [two_tracks(s) for s in SEPARATIONS.values()]
    return SourceTracks(np.stack([p.mean for p in pairs]), np.stack([p.cov for p in pairs]))


def fused(row: str, choice: RuleChoice | None, seed: int, run: int) -> FusedTracks:
    """Fuse all cases; a rule that samples draws anew in each run."""
    tracks = all_cases()
    if choice is None:
        at = TRACKS.index(row)
        return FusedTracks(tracks.mean[:, at], tracks.cov[:, at])
    return choice.fuse(dataclasses.replace(tracks, extras={"seed": stream(seed, run, "fusion_centre")}))


def simulate(runs: Sequence[int], seed: int, progress: Progress, only: str = "") -> Outcomes:
    """Fuse by the rows whose names start with `only`.

    Returns
    -------
    By row: mean (R, 4, 2), cov (R, 4, 2, 2), the weight on track 1 (R, 4) where there is one; of the mixture the
    number of its modes (R, 4)
    """

    def measure(row: str) -> Outcomes:
        each = [fused(row, ROWS[row], seed, run) for run in (runs if _random(row) else runs[:1])]
        each *= len(runs) // len(each)
        if row == MIXTURE:
            return {"modes": np.array([modes(f.mixture) for f in each])}
        weights = [f.weights[:, 0] for f in each if f.weights is not None]
        columns = {"mean": np.stack([f.mean for f in each]), "cov": np.stack([f.cov for f in each])}
        return columns | ({"weight": np.stack(weights)} if weights else {})

    return row_by_row({row: row for row in chosen(ROWS, only)}, progress, measure)


def _random(row: str) -> bool:
    choice = ROWS[row]
    return choice is not None and choice.random


def modes(pairs: Mixture | None) -> Array:
    """Count the modes of mixtures of two Gaussians, (..., 2) components -> (...).

    References    S. Ray and B. Lindsay, The topography of multivariate normal mixtures, 2005: all lie on the line
                  x(t) = ((1 - t) P1^-1 + t P2^-1)^-1 ((1 - t) P1^-1 m1 + t P2^-1 m2), 0 <= t <= 1.
    """
    assert pairs is not None
    t = np.linspace(0.0, 1.0, 4001)
    share = np.stack([1.0 - t, t], -1)
    info = np.linalg.inv(pairs.cov)
    total = np.einsum("tk,...kij->...tij", share, info)
    pull = np.einsum("tk,...kij,...kj->...ti", share, info, pairs.mean)
    height = log_pdf(pairs, np.linalg.solve(total, pull[..., None])[..., 0])
    rising = np.diff(height, axis=-1) > 0.0
    return np.asarray((rising[..., :-1] & ~rising[..., 1:]).sum(-1) + ~rising[..., 0] + rising[..., -1], np.float64)


def figures(outcomes: Outcomes) -> dict[str, Estimate]:
    """Trace and determinant by rule and case, the weight on track 1, and the modes of the mixture."""
    measured = {}
    for name, values in outcomes.items():
        row, _, what = name.rpartition("/")
        for i, case in enumerate(SEPARATIONS):
            if what == "cov":
                cov = values[:, i]
                measured[f"{row}/trace_case_{case}_m2"] = _over_runs(row, np.trace(cov, axis1=1, axis2=2))
                measured[f"{row}/determinant_case_{case}_m4"] = _over_runs(row, np.linalg.det(cov))
            elif what in ("weight", "modes"):
                measured[f"{row}/{what}_case_{case}_1"] = _over_runs(row, values[:, i])
    return measured


def _over_runs(row: str, values: Array) -> Estimate:
    """Average (R,) of what a rule gives, which is exact where nothing is drawn."""
    return Estimate.mean(values) if _random(row) else Estimate.exact(values[0])


def scores(rules: Sequence[RuleChoice], runs: Sequence[int], seed: int, progress: Progress) -> Outcomes:
    """Trace of the fused covariance by case, (R,), under any rules: what is claimed, which need not be true."""

    def measure(choice: RuleChoice) -> Outcomes:
        traces = np.array([np.trace(fused("", choice, seed, r).cov, axis1=1, axis2=2) for r in runs])
        return {f"claimed_trace_case_{case}_m2": traces[:, i] for i, case in enumerate(SEPARATIONS)}

    return rule_by_rule("given", rules, progress, measure)


def charts(outcomes: Outcomes) -> list[Chart]:
    """Ellipses of one standard deviation: the schemes of Fig. 1 in each case, then all other rules."""
    others = [f"given-{choice.name}" for choice in (*CHAIN, *OTHERS)]
    groups = [[f"given-{choice.name}" for choice in SCHEMES]]
    groups += [others[i : i + IN_A_PICTURE] for i in range(0, len(others), IN_A_PICTURE)]
    pictures = [_picture(case, group, outcomes) for group in groups for case in SEPARATIONS]
    return [picture for picture in pictures if len(picture.series) > len(TRACKS)]


def _picture(case: str, rows: Iterable[str], outcomes: Outcomes) -> Chart:
    at = list(SEPARATIONS).index(case)
    pair = two_tracks(SEPARATIONS[case])
    lines = [ellipse(f"P{i + 1}", pair.mean[i], pair.cov[i], 1.0, "dashed") for i in range(pair.count)]
    for row in rows:
        if f"{row}/mean" in outcomes:
            mean, cov = outcomes[f"{row}/mean"][0, at], outcomes[f"{row}/cov"][0, at]
            lines.append(ellipse(row.partition("-")[2], mean, cov, 1.0))
    title = f"({case}) means {SEPARATIONS[case]:g} m apart along x, one-sigma ellipses"
    return Chart(title, "x / m", "y / m", tuple(lines), equal=True)


def _in_every_case(text: str, source: str, rows: Sequence[str], margins: Margins) -> Claim:
    """Claim something of the traces by some rows in each of the cases."""
    needs = tuple(f"{row}/trace_case_{case}_m2" for case in SEPARATIONS for row in rows)

    def of_all(*traces: Array) -> list[Array]:
        return [m for i in range(0, len(traces), len(rows)) for m in margins(*traces[i : i + len(rows)])]

    return Claim(f"in all cases, by the trace: {text}", source, needs, of_all)


def _chain_13(naive: Array, one: Array, two: Array, *rest: Array) -> list[Array]:
    chain = [np.minimum(one, two), *rest]
    return [chain[0] - naive, *_no_falls(*chain)]


def _no_falls(*traces: Array) -> list[Array]:
    """Margins of traces that ascend or stay."""
    return ascending(*(trace * (1.0 + ROUNDING) ** i for i, trace in enumerate(traces)))


def _claims() -> tuple[Claim, ...]:
    naive, geometric, intersection, average, lower, upper = (f"given-{choice.name}" for choice in SCHEMES)
    inverse, tolerant, _ = (f"given-{choice.name}" for choice in CHAIN)
    apart = [
        dataclasses.replace(
            Claim.close(f"the covariance by {row.partition('-')[2]} does not depend on how far apart the means are",
                        "II-C", ROUNDING, *(f"{row}/trace_case_{case}_m2" for case in SEPARATIONS)),
            by_construction="the rule takes it from the covariances alone",
        )
        for row in (geometric, intersection)
    ]  # fmt: skip
    shapes = [
        Claim.near(f"({case}) the mixture before merging has {words}", "II-E, Fig. 1",
                   count, 0.5, f"{MIXTURE}/modes_case_{case}_1")
        for case, count, words in (("a", 1, "one mode"), ("c", 2, "two modes"), ("d", 2, "two modes"))
    ]  # fmt: skip
    return (
        _in_every_case("chain (13), naive < min P <= CU min <= AA <= CU max", "II-E, Fig. 1",
                       (naive, *TRACKS, lower, average, upper), _chain_13),
        _in_every_case("chain (19), naive < ICI < CI <= AA", "II-E, Fig. 1", (naive, inverse, intersection, average),
                       lambda naive, ici, ci, aa: [*ascending(naive, ici, ci), *_no_falls(ci, aa)]),
        _in_every_case("chain (19), CI <= FFCC", "II-C, (19)", (intersection, tolerant), _no_falls),
        _in_every_case("every conservative scheme inflates the covariance of naive fusion", "II-E, Fig. 1",
                       (naive, geometric, intersection, average, lower, upper),
                       lambda naive, *traces: [trace - naive for trace in traces]),
        _in_every_case("AA and CU inflate more than GA and CI", "II-E, Fig. 1",
                       (geometric, intersection, average, lower, upper),
                       lambda *traces: [more - less for less in traces[:2] for more in traces[2:]]),
        *apart,
        *shapes,
    )  # fmt: skip


SCENARIO = Scenario(
    key="li2022-four-cases",
    title="Two Gaussian tracks at four separations, fused by every rule",
    paper=f"{PAPER}, Fig. 1",
    shows="how much each rule inflates the covariance, and which rules see that the tracks contradict each other",
    published=SECTION_2E,
    chosen=tuple(SECTION_2E),
    default_runs=20,
    publication_runs=100,
    assumptions=(
        "assumed: covariances diag(4, 1) and diag(1, 2.4163) m^2, a pair to which trace-optimal covariance "
        "intersection gives w1 = 0.3764; the densities are only in the figure, so that this weight agrees by choice",
        "assumed: means 0.5, 2, 4.5 and 8 m apart along x and half of that along y in cases (a) to (d)",
        "matrices are compared by their traces (footnote 3); intersection, ICI, FFCC and the union's bound go by the "
        "trace, rules that Fig. 1 does not show have their default parameters",
        "runs count only for the rules that sample, whose draws differ from run to run",
    ),
    simulate=simulate,
    figures=figures,
    charts=charts,
    claims=_claims(),
    rules=RULE_CHOICES,
    scores=scores,
)
