"""What is kept of the rows of one_target.py, and the figures and charts made of it: errors, claims, fusion weights."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from track_fusion.angles import difference
from track_fusion.linalg import Array
from track_fusion.metrics.accuracy import Estimate, armse, rmse
from track_fusion.rules import FusedTracks
from track_fusion.study.chart import Chart, Series
from track_fusion.study.one_target import Row, drawn
from track_fusion.study.rows import Outcomes, Progress, chosen
from track_fusion.study.rule_choice import RuleChoice
from track_fusion.study.scene import Tracking

TRUTH = "truth/position_m"
CLAIMED = "claimed_position_m2"
WEIGHT = "sensor_1_weight_1"
#: Rows, by their rules, whose weight on sensor 1 is kept: those that seek it for the sake of the fused density.
WEIGHED = ("arithmetic_average", "arithmetic_average@gaussian", "covariance_intersection")
#: Variants left out of the charts, which hold eight lines.
NOT_DRAWN = ("alone@multinomial", "ic@multinomial", "arithmetic_average@gaussian", "covariance_union@max_trace")
#: A chart whose largest value exceeds its smallest so many times has a logarithmic axis.
LOGARITHMIC_FROM = 10.0


class Quantity(NamedTuple):
    """The norm of some axes of the error, in a unit of its own: position, m."""

    name: str
    unit: str
    axes: tuple[int, ...]
    factor: float = 1.0

    @property
    def error(self) -> str:
        """Name of the errors in the outcomes, (R, T, axes)."""
        return f"{self.name}_error_{self.unit}"

    @property
    def armse(self) -> str:
        """Name of the figure."""
        return f"{self.name}_armse_{self.unit}"


def published(table: Mapping[str, Sequence[float]], quantities: Sequence[Quantity]) -> dict[str, float]:
    """Name the figures of a table that has a column a quantity."""
    return {f"{row}/{q.armse}": v for row, values in table.items() for q, v in zip(quantities, values, strict=True)}


@dataclasses.dataclass(frozen=True)
class OneTargetStudy:
    """A table of rows, each a filter with a rule, over the same Monte Carlo runs.

    Attributes
    ----------
    tracking : Tracking
    quantities : Quantity, position first
    rows : mapping name -> Row
    compared : (str, callable)    name of a filter and RuleChoice -> its Row, for rules that the user names
    """

    tracking: Tracking
    quantities: tuple[Quantity, ...]
    rows: Mapping[str, Row]
    compared: tuple[str, Callable[[RuleChoice], Row]]

    def simulate(self, runs: Sequence[int], seed: int, progress: Progress, only: str = "") -> Outcomes:
        """Run the rows whose names start with `only`.

        Returns
        -------
        By row: errors (R, T, axes) of each quantity, claimed position variance (R, T), the weight on sensor 1 (R, T)
        of WEIGHED rules; and the true position (R, T + 1, 2)
        """
        return self._run(chosen(self.rows, only), runs, seed, progress)

    def _run(self, rows: Mapping[str, Row], runs: Sequence[int], seed: int, progress: Progress) -> Outcomes:
        draws = drawn(self.tracking, runs, seed)
        outcomes: Outcomes = {TRUTH: np.ascontiguousarray(draws.truth[..., self.quantities[0].axes])}
        for done, (name, row) in enumerate(rows.items()):
            kept, step = self._empty(name, len(runs)), row.chunk or len(runs)
            outcomes |= {f"{name}/{key}": array for key, array in kept.items()}
            for begin in range(0, len(runs), step):
                part = slice(begin, min(begin + step, len(runs)))
                for k, fused in enumerate(row.estimates(draws.part(part))):
                    self._keep({key: a[part, k] for key, a in kept.items()}, fused, draws.truth[part, k + 1])
                    share = (begin + (part.stop - begin) * (k + 1) / self.tracking.steps) / len(runs)
                    progress((done + share) / len(rows))
        return outcomes

    def _empty(self, row: str, runs: int) -> Outcomes:
        shapes = {q.error: (len(q.axes),) for q in self.quantities} | {CLAIMED: ()}
        if _rule(row) in WEIGHED:
            shapes[WEIGHT] = ()
        return {key: np.empty((runs, self.tracking.steps, *shape)) for key, shape in shapes.items()}

    def _keep(self, into: Outcomes, fused: FusedTracks, truth: Array) -> None:
        """Write what one step gives, (R, ...), into views of what is kept of it."""
        error = difference(fused.mean, truth, self.tracking.layout.periods)
        for q in self.quantities:
            into[q.error][...] = error[:, q.axes] * q.factor
        axes = self.quantities[0].axes
        into[CLAIMED][...] = np.diagonal(fused.cov, axis1=-2, axis2=-1)[:, axes].sum(-1)
        if WEIGHT in into:
            assert fused.weights is not None
            into[WEIGHT][...] = fused.weights[:, 0]

    def scores(self, rules: Sequence[RuleChoice], runs: Sequence[int], seed: int, progress: Progress) -> Outcomes:
        """Errors of each run, (R,), under rules of any family, with feedback: root of the time-averaged square.

        Of the position also consistency: the squared error over its claim, each averaged over time.
        """
        name, row = self.compared
        rows = {f"{name}-{choice.name}": row(choice) for choice in rules}
        outcomes, scores = self._run(rows, runs, seed, progress), {}
        for one in rows:
            for q in self.quantities:
                scores[f"{one}/{q.name}_rmse_{q.unit}"] = np.sqrt(_squares(outcomes[f"{one}/{q.error}"]).mean(1))
            ratio = self._position_squares(outcomes, one).mean(1) / outcomes[f"{one}/{CLAIMED}"].mean(1)
            scores[f"{one}/consistency_position_1"] = ratio
        return scores

    def figures(self, outcomes: Outcomes) -> dict[str, Estimate]:
        """ARMSE of each quantity; of the position what the covariance claims, and claimed over actual; weights.

        Claims are averaged as errors are: the root of the mean variance over runs, averaged over steps. Credibility
        is the claimed variance over the squared error, each averaged over runs and steps: 1 = the truth, below =
        overconfident.
        """
        estimates: dict[str, Estimate] = {}
        for row in _rows(outcomes):
            for q in self.quantities:
                estimates[f"{row}/{q.armse}"] = armse(_squares(outcomes[f"{row}/{q.error}"]))
            claimed, squares = outcomes[f"{row}/{CLAIMED}"], self._position_squares(outcomes, row)
            estimates[f"{row}/position_claimed_m"] = armse(claimed)
            estimates[f"{row}/position_credibility_1"] = Estimate.ratio(claimed.mean(1), squares.mean(1))
            if f"{row}/{WEIGHT}" in outcomes:
                estimates |= _weight_figures(row, outcomes[f"{row}/{WEIGHT}"])
        return estimates

    def _position_squares(self, outcomes: Outcomes, row: str) -> Array:
        return _squares(outcomes[f"{row}/{self.quantities[0].error}"])

    def charts(self, outcomes: Outcomes) -> list[Chart]:
        """One trial's course, errors and credibility over the steps by filter, and the weight of the average."""
        filters: dict[str, list[str]] = {}
        for row in _rows(outcomes):
            if _rule(row) not in NOT_DRAWN:
                filters.setdefault(row.partition("-")[0], []).append(row)
        charts = [self._course(name, rows, outcomes) for name, rows in filters.items()]
        charts += [self._errors(name, q, rows, outcomes) for q in self.quantities for name, rows in filters.items()]
        charts += [self._credibility(name, rows, outcomes) for name, rows in filters.items()]
        averages = [row for row in _rows(outcomes) if _rule(row) == "arithmetic_average"]
        return charts + ([_weights(averages, outcomes)] if averages else [])

    def _course(self, name: str, rows: Iterable[str], outcomes: Outcomes) -> Chart:
        """Draw the first run's course by the paper's own rows."""
        truth = outcomes[TRUTH][0]
        lines = [Series("truth", truth[:, 0], truth[:, 1])]
        for row in rows:
            if "@" not in row:
                estimates = truth[1:] + outcomes[f"{row}/{self.quantities[0].error}"][0]
                lines.append(Series(_rule(row), estimates[:, 0], estimates[:, 1], "dashed"))
        places = [s.location for s in self.tracking.sensors.values() if hasattr(s, "location")]
        if places:
            x, y = np.stack(places).T
            lines.append(Series("sensors", x, y, "points"))
        return Chart(f"{name.upper()}: course of one trial", "x / m", "y / m", tuple(lines), equal=True)

    def _errors(self, name: str, q: Quantity, rows: Iterable[str], outcomes: Outcomes) -> Chart:
        values = {row: rmse(_squares(outcomes[f"{row}/{q.error}"])) for row in rows}
        what = f"{q.name.replace('_', ' ')} RMSE"
        return _over_steps(f"{name.upper()}: {what}", f"{what} / {q.unit.replace('ps', '/s')}", values)

    def _credibility(self, name: str, rows: Iterable[str], outcomes: Outcomes) -> Chart:
        values = {}
        for row in rows:
            claimed, squares = outcomes[f"{row}/{CLAIMED}"], self._position_squares(outcomes, row)
            values[row] = claimed.mean(0) / squares.mean(0)
        title = f"{name.upper()}: claimed over actual position MSE, 1 = credible"
        return dataclasses.replace(_over_steps(title, "claimed / actual", values), log_y=True)


def _over_steps(title: str, y_label: str, values: Mapping[str, Array]) -> Chart:
    lines = tuple(Series(_rule(row), np.arange(1.0, len(y) + 1), y) for row, y in values.items())
    every = np.concatenate(list(values.values()))
    return Chart(title, "step", y_label, lines, log_y=bool(every.max() > LOGARITHMIC_FROM * every.min() > 0.0))


def _weights(rows: Iterable[str], outcomes: Outcomes) -> Chart:
    lines = []
    for row in rows:
        weight = outcomes[f"{row}/{WEIGHT}"]
        steps = np.arange(1.0, weight.shape[1] + 1)
        lines.append(Series(row.partition("-")[0].upper(), steps, weight.mean(0), error=weight.std(0)))
    return Chart(
        "Arithmetic average: weight on sensor 1, mean and standard deviation over runs", "step", "weight", tuple(lines)
    )


def _weight_figures(row: str, weight: Array) -> dict[str, Estimate]:
    """Mean over all, at the first and at the last step, and standard deviation over runs, averaged over steps."""
    return {
        f"{row}/sensor_1_weight_1": Estimate.mean(weight.mean(1)),
        f"{row}/sensor_1_weight_first_1": Estimate.mean(weight[:, 0]),
        f"{row}/sensor_1_weight_last_1": Estimate.mean(weight[:, -1]),
        f"{row}/sensor_1_weight_sd_1": armse((weight - weight.mean(0)) ** 2),
    }


def _squares(errors: Array) -> Array:
    """Squared norms (R, T) of errors (R, T, axes)."""
    return np.asarray((errors**2).sum(-1))


def _rule(row: str) -> str:
    return row.partition("-")[2]


def _rows(outcomes: Outcomes) -> list[str]:
    """Names of the rows in outcomes, in their order."""
    return list(dict.fromkeys(name.partition("/")[0] for name in outcomes if name != TRUTH))
