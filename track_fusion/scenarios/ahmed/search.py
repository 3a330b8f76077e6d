"""Ahmed, Gaussian-mixture DDF, 5.3: five robots look for a target and see nothing; robot 3 hears from the others."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property, partial

import numpy as np

from track_fusion.densities.log_domain import normalised
from track_fusion.densities.mixture.mixture import Mixture, log_pdf
from track_fusion.densities.mixture.reduction import prune, runnalls
from track_fusion.densities.on_grid import grid, kl_on_grid
from track_fusion.filters.negative_information import NegativeInformation
from track_fusion.linalg import Array
from track_fusion.metrics.accuracy import Estimate
from track_fusion.models.detection import SoftmaxDetector
from track_fusion.params import ParameterError
from track_fusion.peers import Fuse, Peer, by_rule, communicate, on_tree, star, sweep
from track_fusion.random_streams import stream
from track_fusion.rules.mixture_exact import MixtureExactParams
from track_fusion.rules.mixture_wep import MixtureWepParams
from track_fusion.scenarios.ahmed import PAPER
from track_fusion.study.chart import Chart, Contours, Series, bars
from track_fusion.study.claim import Claim
from track_fusion.study.rows import Outcomes, Progress, chosen, run_by_run
from track_fusion.study.rule_choice import RuleChoice
from track_fusion.study.scenario import Scenario
from track_fusion.tracks import StateLayout

#: Text of 5.3 and caption of Fig. 9: divergence of robot 3's fused mixture from the centralised one.
FIGURE_9 = {"gm-mixture_exact/kld_nats": 0.1173}

LAYOUT = StateLayout(("x", "y"))
STEPS, STEP_M = 50, 0.1
COMPONENTS = 50
REACH_M, HALF_ANGLE_RAD, STEEPNESS = 1.5, math.radians(30.0), 4.0
PRIOR_SPACING_M, PRIOR_JITTER_M, PRIOR_VARIANCE_M2 = 3.0, 0.5, 0.8
#: Start (m) and heading (degrees from x towards y) of each robot.
ROBOTS = {
    "1": ((-4.5, -4.5), 75.0),
    "2": ((-4.5, 4.5), -20.0),
    "3": ((4.5, -4.5), 110.0),
    "4": ((4.5, 4.5), 195.0),
    "5": ((-1.0, -4.5), 20.0),
}
HUB = "3"
LINKS = star(HUB, [name for name in ROBOTS if name != HUB])
NO_DETECTION = np.array([0.0, 1.0, 1.0, 1.0])
#: Points for the moments of a component cut by a view cone, and below which relative variation it is not cut.
FILTER = NegativeInformation(samples=256, negligible=0.1)
#: Components below this share are dropped before Runnalls' merging.
NEGLIGIBLE = 1e-9

#: Divergences and masses are sums over a regular grid of GRID^2 cells on +-HALF_GRID_M; charts show every other cell.
HALF_GRID_M, GRID = 7.0, 160
POINTS = grid(np.full(2, -HALF_GRID_M), np.full(2, HALF_GRID_M), GRID)
NEAR_M = 1.5

DLS = MixtureExactParams(
    method="dls", proposal="ingis", default_variance=0.5, mixand_samples=500, max_components=COMPONENTS,
    not_integrable="skip",
)  # fmt: skip
WEP = MixtureWepParams(method="dls", proposal="heavy_tail", max_components=COMPONENTS, omega_error=1.0)
RULE_CHOICES = (
    RuleChoice("mixture_exact", DLS),
    RuleChoice("mixture_exact", dataclasses.replace(DLS, proposal="heavy_tail"), "heavy_tail"),
    RuleChoice("mixture_exact", dataclasses.replace(DLS, method="igs", samples=2000), "igs"),
    RuleChoice("mixture_exact", dataclasses.replace(DLS, method="mmgd"), "mmgd"),
    RuleChoice("mixture_wep", WEP),
    RuleChoice.of("mixture_wep", "naive_bayes", method="naive_bayes", max_components=COMPONENTS),
)
#: The centre; robot 3 before it hears of the others; the quotient of the robots' mixtures itself, on the grid.
CENTRE, ALONE, QUOTIENT = "gm-ic", "gm-alone", "gm-mixture_exact@unapproximated"


def cone(robot: str, step: int) -> SoftmaxDetector:
    """View cone of a robot at steps 1 to 50, after so many steps straight ahead."""
    (x, y), degrees = ROBOTS[robot]
    heading, way = math.radians(degrees), step * STEP_M
    tip = x + way * math.cos(heading), y + way * math.sin(heading)
    return SoftmaxDetector.view_cone(LAYOUT, tip, heading, REACH_M, HALF_ANGLE_RAD, STEEPNESS)


def prior(runs: Sequence[int], seed: int) -> Mixture:
    """Nine equal components on a jittered 3 x 3 grid, weight (R, 9)."""
    side = np.linspace(-PRIOR_SPACING_M, PRIOR_SPACING_M, 3)
    centres = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    jitter = np.stack([stream(seed, r, "prior").uniform(-1.0, 1.0, centres.shape) for r in runs]) * PRIOR_JITTER_M
    lead = (len(runs), len(centres))
    cov = np.broadcast_to(PRIOR_VARIANCE_M2 * np.eye(2), (*lead, 2, 2))
    return Mixture(np.full(lead, 1.0 / len(centres)), centres + jitter, cov)


def searched(start: Mixture, robots: Iterable[str]) -> Mixture:
    """Condition on what these robots did not see in 50 steps, reduced to 50 components after each view."""
    robots, mixture = tuple(robots), start
    for step in range(1, STEPS + 1):
        for robot in robots:
            mixture, _ = FILTER.update(mixture, NO_DETECTION, cone(robot, step))
            mixture = runnalls(prune(mixture, NEGLIGIBLE)[0], COMPONENTS)
    return mixture


def bayes(start: Mixture) -> Array:
    """Log of the true posterior given all views on the grid, (R, G), not normalised."""
    log_density = log_pdf(start, POINTS)
    for robot in ROBOTS:
        for step in range(1, STEPS + 1):
            log_density = log_density + np.log1p(-np.exp(cone(robot, step).log_probability(POINTS)[:, 0]))
    return log_density


def fused(choice: RuleChoice, start: Mixture, local: Mapping[str, Mixture], seed: int) -> Mixture:
    """Robot 3's mixture after the others sent theirs: by channel filters where the rule uses common information."""
    fuse, exact = _fuse(choice, seed)
    peers = on_tree(local, start, LINKS) if exact else {name: Peer(mixture) for name, mixture in local.items()}
    return communicate(peers, sweep(LINKS, HUB)[0], fuse)[HUB].density


def _fuse(choice: RuleChoice, seed: int) -> tuple[Fuse[Mixture], bool]:
    try:
        return by_rule(choice.rule, choice.params, seed), "common" in choice.rule.needed(choice.params)
    except ValueError as error:
        raise ParameterError(f"The rule must be one for peers: {error}") from error


def quotient(start: Mixture, local: Mapping[str, Mixture]) -> Array:
    """Log of the product of the robots' mixtures over what they share, on the grid, (R, G): no approximation."""
    total = sum((log_pdf(m, POINTS) for m in local.values()), np.zeros(len(POINTS)))
    return np.asarray(total - len(LINKS) * log_pdf(start, POINTS))


class Search:
    """One run: its prior, what robots that saw everything or only their own views make of it, (1, ...) each."""

    def __init__(self, run: int, seed: int, progress: Progress) -> None:
        self.seed, self.start, self._progress = seed, prior([run], seed), progress
        self.centre = log_pdf(searched(self.start, ROBOTS), POINTS)
        progress(0.25)

    @cached_property
    def local(self) -> dict[str, Mixture]:
        """Each robot's mixture before anybody talks."""
        local = {}
        for done, robot in enumerate(ROBOTS, 1):
            local[robot] = searched(self.start, [robot])
            self._progress(0.25 + 0.25 * done / len(ROBOTS))
        return local

    def fused(self, choice: RuleChoice) -> Array:
        """Log of robot 3's mixture after fusion on the grid."""
        return log_pdf(fused(choice, self.start, self.local, self.seed), POINTS)


#: What gives each row's density on the grid.
ROWS: dict[str, Callable[[Search], Array]] = {
    CENTRE: lambda search: search.centre,
    ALONE: lambda search: log_pdf(search.local[HUB], POINTS),
    **{f"gm-{choice.name}": partial(Search.fused, choice=choice) for choice in RULE_CHOICES},
    QUOTIENT: lambda search: quotient(search.start, search.local),
}


def simulate(runs: Sequence[int], seed: int, progress: Progress, only: str = "") -> Outcomes:
    """Search with these jittered priors: per row the divergences, (R,), the mass near the target, and the density.

    Notes    Run by run: which components are cut and merged differs from run to run, so a batch saves no time, and
             its rounding may decide which are.
    """
    rows = chosen(ROWS, only)

    def one(run: int, tell: Progress) -> Outcomes:
        search = Search(run, seed, tell)
        truth = bayes(search.start)
        outcomes = {"prior": _thinned(log_pdf(search.start, POINTS)), "bayes": _thinned(truth)}
        for done, (row, density) in enumerate(rows.items(), 1):
            outcomes |= _measured(row, density(search), search.centre, truth)
            tell(0.5 + 0.5 * done / len(rows))
        return {name: values[0] for name, values in outcomes.items()}

    return run_by_run(runs, progress, one)


def _measured(row: str, density: Array, centre: Array, truth: Array) -> Outcomes:
    near = (POINTS**2).sum(-1) < NEAR_M**2
    from_centre = {} if row == CENTRE else {f"{row}/kld_nats": kl_on_grid(centre, density)}
    return from_centre | {
        f"{row}/kld_from_bayes_nats": kl_on_grid(truth, density),
        f"{row}/mass_near_target_1": normalised(density)[:, near].sum(-1),
        row: _thinned(density),
    }


def _thinned(log_density: Array) -> Array:
    """Density per square metre at every other cell of the grid, (R, GRID / 2, GRID / 2), y before x."""
    cell = (2.0 * HALF_GRID_M / GRID) ** 2
    on_grid = normalised(log_density).reshape(-1, GRID, GRID) / cell
    return np.swapaxes(on_grid, 1, 2)[:, ::2, ::2]


def figures(outcomes: Outcomes) -> dict[str, Estimate]:
    """Average the divergences and masses over the priors."""
    return {name: Estimate.mean(values) for name, values in outcomes.items() if "/" in name}


def scores(rules: Sequence[RuleChoice], runs: Sequence[int], seed: int, progress: Progress) -> Outcomes:
    """Divergence from the centralised mixture of robot 3's after fusion by any rule for peers, (R,) each."""

    def one(run: int, tell: Progress) -> dict[str, float]:
        search, divergences = Search(run, seed, tell), {}
        for done, choice in enumerate(rules, 1):
            divergences[f"gm-{choice.name}/kld_nats"] = float(kl_on_grid(search.centre, search.fused(choice))[0])
            tell(0.5 + 0.5 * done / len(rules))
        return divergences

    return run_by_run(runs, progress, one)


# Pictures.

PANELS = {
    "prior": "Prior, and the robots' ways",
    "bayes": "True posterior given all views",
    CENTRE: "Centralised mixture",
    ALONE: "Robot 3 before it hears from the others",
    "gm-mixture_exact": "Robot 3 after exact fusion (DLS)",
    "gm-mixture_exact@mmgd": "Robot 3 after fusion by MMGD",
}
#: Contours at these shares of the panel's highest density.
LEVELS = (0.05, 0.2, 0.4, 0.6, 0.8)


def charts(outcomes: Outcomes) -> list[Chart]:
    """Densities of the first run as contours, as Fig. 9, and the divergences of all rows."""
    side = (np.arange(0, GRID, 2) + 0.5) * 2.0 * HALF_GRID_M / GRID - HALF_GRID_M
    ways, panels = _ways(), []
    for name, title in PANELS.items():
        if name in outcomes:
            z = outcomes[name][0]
            levels = tuple(float(share * z.max()) for share in LEVELS)
            shown = ways if name == "prior" else ways[:1] if name == ALONE else ()
            contours = (Contours("density", side, side, z, levels),)
            panels.append(Chart(title, "x, m", "y, m", shown, contours, equal=True))
    divergences = {
        name.removeprefix("gm-").removesuffix("/kld_nats"): estimate
        for name, estimate in figures(outcomes).items()
        if name.endswith("/kld_nats")
    }
    if divergences:
        panels.append(bars("Divergence from the centralised mixture", "KLD, nats", divergences, log_y=True))
    return panels


def _ways() -> tuple[Series, ...]:
    """Each robot's way and its first view cone, robot 3's first."""
    lines = []
    for robot in (HUB, *(name for name in ROBOTS if name != HUB)):
        (x, y), degrees = ROBOTS[robot]
        heading = math.radians(degrees)
        edge = REACH_M / math.cos(HALF_ANGLE_RAD)
        corners = [heading + HALF_ANGLE_RAD, heading - HALF_ANGLE_RAD]
        xs = [x + STEPS * STEP_M * math.cos(heading), x, *(x + edge * math.cos(a) for a in corners), x]
        ys = [y + STEPS * STEP_M * math.sin(heading), y, *(y + edge * math.sin(a) for a in corners), y]
        lines.append(Series(f"robot {robot}", np.array(xs), np.array(ys)))
    return tuple(lines)


CLAIMS = (
    Claim("the centralised mixture of 50 components is a very close approximation of the true posterior "
          "(judged: at most a tenth as far from it as robot 3's before fusion)", "5.3, Fig. 9 (b)",
          (f"{CENTRE}/kld_from_bayes_nats", f"{ALONE}/kld_from_bayes_nats"),
          lambda centre, alone: [0.1 * alone - centre]),
    Claim.order("fusion brings robot 3 nearer to the centralised mixture than it was alone", "5.3, Fig. 9 (c), (d)",
                "gm-mixture_exact/kld_nats", f"{ALONE}/kld_nats"),
    Claim.order("replacing the common information by one Gaussian (MMGD) loses more than sampling the quotient",
                "2.4, 5.1", "gm-mixture_exact/kld_nats", "gm-mixture_exact@mmgd/kld_nats"),
    Claim.order("the modes near the target are diminished by decentralised fusion and its repeated compression "
                "(judged: mass within 1.5 m of it below the centralised mixture's)", "5.3, Fig. 9 (d)",
                "gm-mixture_exact/mass_near_target_1", f"{CENTRE}/mass_near_target_1"),
)  # fmt: skip


SCENARIO = Scenario(
    key="ahmed-search",
    title="Five robots search for a target that none of them sees",
    paper=f"{PAPER}, 5.3",
    shows="exact decentralised fusion of mixtures over a star with channel filters, beside the centralised mixture",
    published=FIGURE_9,
    default_runs=3,
    publication_runs=20,
    assumptions=(
        "assumed: prior of nine equal components of variance 0.8 m^2 on a 3 x 3 grid of 3 m, each jittered by up to "
        "0.5 m along each axis, anew in every run",
        "assumed: view cones of 1.5 m and +-30 degrees, softmax edges of steepness 4/m, detection certain inside",
        "assumed: starts and headings of the robots (robot 3 in the lower right corner), straight ways of 0.1 m a step",
        "every run takes it that no robot detects anything in 50 steps, as in the paper",
        "a component that a view cone cuts by less than a tenth (standard deviation over mean of the probability of no "
        "detection) is weighed, not split: splitting all makes the centralised mixture 20 times worse",
        "Runnalls' reduction to 50 components after each robot's view and after each message",
        "robot 3 fuses the messages of robots 1, 2, 4, 5 in this order; the fifty views all come before",
        "divergences are sums over a grid of 160 x 160 cells on +-7 m",
        "pairs of components whose quotient has no integral are left out",
        "the printed divergence belongs to the prior and ways of Fig. 9, a picture: its magnitude alone compares",
    ),
    simulate=simulate,
    figures=figures,
    charts=charts,
    claims=CLAIMS,
    piece=1,
    rules=RULE_CHOICES,
    given=("common",),
    scores=scores,
)
