"""Ahmed, Gaussian mixture DDF, section 5.1: exact and weighted-exponential-product fusion of random mixtures."""

from __future__ import annotations

import functools
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from track_fusion.densities.on_grid import kl_on_grid
from track_fusion.linalg import Array
from track_fusion.metrics.accuracy import Estimate
from track_fusion.random_streams import stream
from track_fusion.rules import FusedTracks
from track_fusion.scenarios.ahmed import PAPER
from track_fusion.scenarios.ahmed.mixtures import INGIS_VARIANCE, Problem, contour_chart, log_fused, scores, shown
from track_fusion.study.chart import Chart, Series
from track_fusion.study.claim import Claim, ascending
from track_fusion.study.rows import Outcomes, Progress, chosen, run_by_run
from track_fusion.study.rule_choice import RuleChoice
from track_fusion.study.scenario import Printed, Scenario

#: Figs. 4 and 5, one problem: divergence in nats of the true fused density from each approximation.
FIGURES_4_5 = {
    "given-mixture_exact@example_dls_500": 0.0104,
    "given-mixture_exact@example_igs_1000": 0.0281,
    "given-mixture_exact@example_mmgd": 1.1264,
    "given-mixture_exact@example_laplace": 1.0023,
    "given-mixture_exact@example_em_5000": 1.0505,
    "given-mixture_wep@example_dls_500": 0.0029,
    "given-mixture_wep@example_igs_1000": 0.0848,
    "given-mixture_wep@example_foci": 0.6975,
    "given-mixture_wep@example_em_5000": 0.1035,
    "given-mixture_wep@example_naive_bayes": Printed("0.30"),
}
#: Section 5.1: effective sample size of the 1000 samples of IGS in Fig. 5.
EFFECTIVE_SAMPLES = {"given-mixture_wep@example_igs_1000": 284}
#: Times are given in that of these methods: the closed forms. The seconds of Table 1 are another machine's.
QUICKEST = {"mixture_exact": "mmgd", "mixture_wep": "naive_bayes"}
#: Order of the seconds in Table 1: .07 .19 .46 .60 1.72 and .09 .74 1.09 1.64.
QUICKEST_FIRST = {
    "mixture_exact": ("mmgd", "laplace", "dls_500", "igs_1000", "em_5000"),
    "mixture_wep": ("naive_bayes", "igs_1000", "dls_500", "em_5000"),
}

#: Numbers of samples of Fig. 6: of DLS a mixand, of IGS in all; and of the search for omega, but for IGS, which uses
#: its own.
DLS_SAMPLES, IGS_SAMPLES = (10, 50, 100, 200), (100, 500, 1000, 2000)
OMEGA_SAMPLES = 5000
#: Numbers of components: of a source, of the common information.
STUDY, EXAMPLE = ((10, 11), (40, 41)), ((14,), (40,))
#: Problems of which a picture shows each divergence.
SHOWN_PROBLEMS = 40


def _choice(key: str, variant: str, **values: Any) -> RuleChoice:
    common: dict[str, Any] = {"max_components": 0}
    if key == "mixture_wep":
        # As the paper has it, omega is sought on one set of samples, whatever its error.
        common |= {"criterion": "minimax_information_loss", "samples": OMEGA_SAMPLES, "omega_proposal": "first_order"}
        common["omega_error"] = 1.0
    return RuleChoice.of(key, variant, **common | values)


def _dls(key: str, variant: str, count: int) -> RuleChoice:
    return _choice(key, variant, proposal="ingis", default_variance=INGIS_VARIANCE, mixand_samples=count)


def _study_rows() -> Iterator[RuleChoice]:
    """Methods of Fig. 6, and IGS for WEP fusion from the proposal that counts overlaps, the rule's own."""
    for key, rough in (("mixture_exact", "mmgd"), ("mixture_wep", "foci")):
        yield from (_dls(key, f"dls_{s}", s) for s in DLS_SAMPLES)
        yield from (_choice(key, f"igs_{s}", method="igs", samples=s) for s in IGS_SAMPLES)
        yield _choice(key, rough, method=rough)
    for s in IGS_SAMPLES:
        yield _choice("mixture_wep", f"igs_{s}_overlap", method="igs", samples=s, omega_proposal="overlap")


def _example_rows() -> Iterator[RuleChoice]:
    """Methods of Figs. 4 and 5 and Table 1."""
    for key in ("mixture_exact", "mixture_wep"):
        yield _dls(key, "example_dls_500", 500)
        yield _choice(key, "example_igs_1000", method="igs", samples=1000)
    yield from (_choice("mixture_exact", f"example_{name}", method=name) for name in ("mmgd", "laplace"))
    yield _choice("mixture_exact", "example_em_5000", method="common_proposal", samples=5000)
    yield _choice("mixture_wep", "example_em_5000", method="is_wem")
    yield from (_choice("mixture_wep", f"example_{name}", method=name) for name in ("foci", "naive_bayes"))


RULE_CHOICES = (*_study_rows(), *_example_rows())
ROWS = {f"given-{choice.name}": choice for choice in RULE_CHOICES}
#: Examples that pictures show, Figs. 4 and 5.
PICTURES = {f"{name}/density": name for name in ROWS if name.endswith(("example_dls_500", "example_igs_1000",
            "example_mmgd", "example_foci"))}  # fmt: skip


def study_problem(seed: int, run: int) -> Problem:
    """Draw a problem of the study of Fig. 6."""
    return Problem.drawn(stream(seed, run, "problem"), *STUDY)


def example_problem(seed: int, run: int) -> Problem:
    """Draw a problem of the sizes of the example in Fig. 3."""
    return Problem.drawn(stream(seed, run, "example"), *EXAMPLE)


class Case:
    """A problem with what is to be known of it once: true densities, the times of the quickest methods."""

    def __init__(self, problem: Problem, seed: int, run: int) -> None:
        self.problem, self.seed, self.run = problem, seed, run

    def fuse(self, choice: RuleChoice) -> tuple[FusedTracks, float]:
        """Fuse by a rule, whose random numbers are the same for every rule; the processor time it took, in seconds."""
        tracks = self.problem.tracks(stream(self.seed, self.run, "fusion"))
        began = time.process_time()
        return choice.fuse(tracks), time.process_time() - began

    @functools.cached_property
    def log_truth(self) -> dict[str, Array]:
        """Logarithm of the true fused density on the grid, by rule."""
        weights = self.fuse(_choice("mixture_wep", "", method="foci"))[0].weights
        assert weights is not None
        omega = float(weights[0])
        return {"mixture_exact": self.problem.log_exact(), "mixture_wep": self.problem.log_wep(omega)}

    @functools.cached_property
    def quickest_s(self) -> dict[str, float]:
        """Time of the quickest method, by rule."""
        return {key: self.fuse(_choice(key, "", method=method))[1] for key, method in QUICKEST.items()}

    def measure(self, choice: RuleChoice) -> dict[str, Any]:
        """Quantities of one row of figures."""
        fused, took_s = self.fuse(choice)
        truth, approximation = self.log_truth[choice.key], log_fused(fused)
        values: dict[str, Any] = {"kld_nats": kl_on_grid(truth, approximation)}
        drawn = _samples_of(choice)
        if drawn:
            values["effective_samples_1"] = drawn * float(fused.info["ess"])
        values["time_ratio_1"] = took_s / self.quickest_s[choice.key]
        if f"given-{choice.name}/density" in PICTURES:
            values |= {"density": shown(approximation), "truth": shown(truth)}
        return values


def _samples_of(choice: RuleChoice) -> int:
    """Return how many samples the moments of a fused density, or of one of its mixands (DLS), come from."""
    method, params = getattr(choice.params, "method"), choice.params  # noqa: B009
    names = {"dls": "mixand_samples", "igs": "samples", "is_wem": "samples", "common_proposal": "samples"}
    return int(getattr(params, names[method])) if method in names else 0


def simulate(runs: Sequence[int], seed: int, progress: Progress, only: str = "") -> Outcomes:
    """Fuse a problem a run by the methods whose rows start with `only`: divergence, effective samples, time, (R,).

    Notes    Times, `.../time_ratio_1`, are measured by the clock: they alone differ from one call to the next.
    """
    rows = chosen(ROWS, only)

    def one(run: int, tell: Progress) -> dict[str, Any]:
        study, example = Case(study_problem(seed, run), seed, run), Case(example_problem(seed, run), seed, run)
        outcomes: dict[str, Any] = {}
        for done, (name, choice) in enumerate(rows.items(), 1):
            case = example if choice.variant.startswith("example") else study
            outcomes |= {f"{name}/{quantity}": value for quantity, value in case.measure(choice).items()}
            tell(done / len(rows))
        return outcomes

    return run_by_run(runs, progress, one)


def figures(outcomes: Outcomes) -> dict[str, Estimate]:
    """Medians over the problems."""
    return {name: Estimate.median(values) for name, values in outcomes.items() if values.ndim == 1}


def charts(outcomes: Outcomes) -> list[Chart]:
    """Divergence by method over all problems, Fig. 6; the first example's densities, Figs. 4 and 5."""
    return [*_divergences(outcomes), *_densities(outcomes)]


def _divergences(outcomes: Outcomes) -> Iterator[Chart]:
    for key, title in (("mixture_exact", "Exact fusion"), ("mixture_wep", "WEP fusion")):
        start = f"given-{key}@"
        names = [n for n in outcomes if n.startswith(start) and n.endswith("/kld_nats") and "@example" not in n]
        if not names:
            continue
        at = np.arange(len(names), dtype=float)
        each = np.array([outcomes[n][:SHOWN_PROBLEMS] for n in names])
        median = np.array([np.median(outcomes[n]) for n in names])
        ticks = {x: n.removeprefix(start).removesuffix("/kld_nats") for x, n in zip(at, names, strict=True)}
        family = [n.rstrip("0123456789") for n in ticks.values()]
        breaks = [i for i in range(1, len(names)) if family[i] != family[i - 1]]
        lines = (
            Series("a problem", np.repeat(at, each.shape[1]), each.ravel(), "points"),
            Series("median", np.insert(at, breaks, np.nan), np.insert(median, breaks, np.nan), "line"),
        )
        yield Chart(f"{title}: divergence from the truth", "method and samples", "nats", lines, log_y=True, ticks=ticks)


def _densities(outcomes: Outcomes) -> Iterator[Chart]:
    for density, name in PICTURES.items():
        if density in outcomes:
            key, _, method = name.removeprefix("given-").partition("@example_")
            method = method.upper().replace("_", " with ")
            title = f"{'Exact' if key == 'mixture_exact' else 'WEP'} fusion, first example: {method}"
            pictures = {"true density": outcomes[f"{name}/truth"][0], method: outcomes[density][0]}
            yield contour_chart(title, pictures)


def _names(key: str, *variants: str, quantity: str = "kld_nats") -> tuple[str, ...]:
    return tuple(f"given-{key}@{variant}/{quantity}" for variant in variants)


def _claims() -> Iterator[Claim]:
    for key, kind in (("mixture_exact", "exact"), ("mixture_wep", "WEP")):
        dls = [f"dls_{s}" for s in DLS_SAMPLES]
        igs = [f"igs_{s}" for s in IGS_SAMPLES]
        figure, rough = ("Fig. 6(a)", "mmgd") if kind == "exact" else ("Fig. 6(b)", "foci")
        yield Claim.order(f"{kind} fusion by DLS improves with the samples", figure, *_names(key, *reversed(dls)))
        yield Claim.order(f"{kind} fusion by IGS improves with the samples", figure, *_names(key, *reversed(igs)))
        yield Claim.each(
            f"{kind} fusion: DLS is more accurate than IGS in nearly all cases (judged: in the median at each of the "
            "four numbers of samples)", figure, _names(key, *dls), _names(key, *igs), ascending,
        )  # fmt: skip
        yield Claim(
            f"{kind} fusion: DLS and IGS improve on {rough.upper()} (judged: with each of their numbers of samples)",
            f"Section 6, {figure}", _names(key, *dls, *igs, rough),
            lambda *all_: [all_[-1] - divergence for divergence in all_[:-1]],
        )  # fmt: skip
    for key in ("mixture_exact", "mixture_wep"):
        printed = {name: value for name, value in FIGURES_4_5.items() if name.startswith(f"given-{key}@")}
        order = [name.partition("@")[2] for name in sorted(printed, key=lambda name: printed[name])]
        listed = ", ".join(name.removeprefix("example_") for name in order)
        source = "Fig. 4" if key == "mixture_exact" else "Fig. 5"
        yield Claim.order(f"in the example, from the best: {listed}", source, *_names(key, *order))
    yield Claim.order("IGS with 1000 samples is more accurate than expectation maximisation of 5000",
                      "Section 5.1, Fig. 5", *_names("mixture_wep", "example_igs_1000", "example_em_5000"))  # fmt: skip
    for key, methods in QUICKEST_FIRST.items():
        yield Claim.order(
            f"time of {'exact' if key == 'mixture_exact' else 'WEP'} fusion, from the least: {', '.join(methods)}",
            "Table 1",
            *_names(key, *(f"example_{method}" for method in methods), quantity="time_ratio_1"),
        )


SCENARIO = Scenario(
    key="ahmed-random",
    title="Random Gaussian mixtures, fused exactly and by weighted exponential products",
    paper=f"{PAPER}, 5.1",
    shows="how near each way of dividing mixtures comes to the true fused density, by its number of samples",
    published={f"{row}/kld_nats": value for row, value in FIGURES_4_5.items()}
    | {f"{row}/effective_samples_1": value for row, value in EFFECTIVE_SAMPLES.items()},
    default_runs=20,
    publication_runs=20,
    assumptions=(
        "the densities of Figs. 3-5 are only drawn: rows named example are medians over problems with as many "
        "components, drawn like those of Fig. 6; the one printed value stands beside them",
        "assumed: covariances are Wishart of 10 degrees of freedom and scale .75 I, of mean 7.5 I, which goes with "
        "INGIS at alpha = 5",
        "the true densities are taken on a grid of 100 x 100 cells over +-28",
        "omega is found by minimax information loss: for DLS, FOCI and expectation maximisation with 5000 samples, "
        "for IGS with its own; the true product is that at the omega of 5000",
        "Algorithm 1 draws from (14)-(17) at omega 1/2, as printed; rows that end in overlap weight its components by "
        "the overlap of each pair, as the rule does unless told otherwise",
        "Fig. 4(d), captioned DLS in the text, is IGS with 1000 samples; weights, means and covariances of Fig. 3's "
        "expectation maximisation start at samples drawn by their weights",
        "Laplace's mixands are weighted by their zeroth moments (49), which Algorithm 4 leaves out: without them the "
        "divergence in the examples would be .43 nats instead of .09",
        "effective samples: of DLS a mixand, averaged by the mixands' weights",
        "times are processor times of one problem, in those of MMGD (exact) or of the naive product (WEP) for the same "
        "problem: they differ from machine to machine and from call to call, and are the only figures that do",
    ),
    simulate=simulate,
    figures=figures,
    charts=charts,
    claims=tuple(_claims()),
    piece=2,
    rules=RULE_CHOICES,
    given=("common",),
    scores=functools.partial(scores, study_problem),
)
