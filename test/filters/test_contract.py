"""The laws of every filter: states are values, a batch is a loop, moments are those of a density; none is left out."""

from __future__ import annotations

import copy
import dataclasses
import doctest
import importlib
import inspect
import pkgutil
from typing import Any, NamedTuple

import numpy as np
import pytest

from track_fusion import filters
from track_fusion.densities.mixture.mixture import Mixture, moments
from track_fusion.filters.base import Gaussian
from track_fusion.filters.cubature import Cubature
from track_fusion.filters.extended import Extended
from track_fusion.filters.gaussian_student_t_mixture import GaussianStudentTMixture
from track_fusion.filters.gaussian_sum_modes import GaussianSumModes, MixtureModes
from track_fusion.filters.interacting_multiple_model import InteractingMultipleModel, Modes
from track_fusion.filters.iterated_corrector import IteratedCorrector
from track_fusion.filters.kalman import Kalman
from track_fusion.filters.negative_information import NegativeInformation
from track_fusion.filters.particle import Particles, Sir, SirParams
from track_fusion.filters.probabilistic_data_association import Candidate, ProbabilisticDataAssociation, Scan
from track_fusion.filters.square_root_cubature import SquareRootCubature
from track_fusion.filters.student_t import StudentT
from track_fusion.filters.unscented import Unscented
from track_fusion.models.detection import SoftmaxDetector
from track_fusion.models.measurement import LinearSensor, RangeBearingSensor
from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
from track_fusion.models.turn import KnownTurn, KnownTurnParams
from track_fusion.tracks import planar_layout

RUNS, LAYOUT = 3, planar_layout()
RNG = np.random.default_rng(0)
MEAN = np.array([300.0, 100.0, 20.0, 5.0]) + RNG.normal(size=(RUNS, 4)) * [9.0, 9.0, 2.0, 2.0]
COV = np.tile(np.diag([25.0, 16.0, 4.0, 4.0]) + 1.0, (RUNS, 1, 1))
MOTION = NearlyConstantVelocity(LAYOUT, MotionParams(process_noise=2.0)).over(0.5)
TURNS = [KnownTurn(LAYOUT, KnownTurnParams(turn_rate=w)).over(0.5) for w in (0.0, 0.3)]
RADAR = RangeBearingSensor(LAYOUT, 5.0, 0.02, (-100.0, 0.0))
POSITION = LinearSensor.position(LAYOUT, 4.0)
CONE = SoftmaxDetector.view_cone(LAYOUT, (290.0, 100.0), 0.0, 30.0, 0.5, 1.0)
SEEN, PLACE = RADAR.observe(MEAN) + RNG.normal(size=(RUNS, 2)) * [5.0, 0.02], MEAN[:, :2] + RNG.normal(size=(RUNS, 2))
CHAIN = np.array([[0.9, 0.1], [0.2, 0.8]])
TWO = Mixture(np.full((RUNS, 2), 0.5), np.stack([MEAN, MEAN + 3.0], 1), np.stack([COV, 2.0 * COV], 1))
SUMS = Mixture(*(np.stack([a, a], 1) for a in (TWO.weight, TWO.mean, TWO.cov)))


class Case(NamedTuple):
    """A filter, a state of a batch, and what moves and updates it."""

    one: Any
    state: Any
    motion: Any
    z: Any
    sensor: Any


def track(one: Any, z: Any = SEEN, sensor: Any = RADAR) -> Case:
    return Case(one, one.begin(MEAN, COV), MOTION, z, sensor)


CASES = {
    "kalman": track(Kalman(), PLACE, POSITION),
    "extended": track(Extended()),
    "unscented": track(Unscented()),
    "cubature": track(Cubature()),
    "square_root_cubature": track(SquareRootCubature()),
    "student_t": track(StudentT()),
    "gaussian_student_t_mixture": track(GaussianStudentTMixture(dof=4.0)),
    "particle": track(Sir(SirParams(particles=50, role="a"), tuple(range(RUNS)))),
    "iterated_corrector": Case(
        IteratedCorrector(Extended()), Gaussian(MEAN, COV), MOTION, [SEEN, PLACE], [RADAR, POSITION]
    ),
    "interacting_multiple_model": Case(
        InteractingMultipleModel(CHAIN), Modes.start(np.array([0.6, 0.4]), MEAN, COV), TURNS, SEEN, RADAR
    ),
    "gaussian_sum_modes": Case(
        GaussianSumModes(CHAIN, 3), MixtureModes(np.full((RUNS, 2), 0.5), SUMS), TURNS, SEEN, RADAR
    ),
    "probabilistic_data_association": Case(
        ProbabilisticDataAssociation(), Candidate(MEAN, COV, np.full(RUNS, 0.7)), MOTION,
        Scan(np.stack([SEEN, SEEN + [9.0, 0.01]], 1), np.array([[True, True], [True, False], [False, False]])), RADAR,
    ),
    "negative_information": Case(NegativeInformation(128), TWO, MOTION, np.array([0.3, 1.0, 1.0, 1.0]), CONE),
}  # fmt: skip
TRACKS = [key for key, case in CASES.items() if hasattr(case.one, "begin")]


def stepped(case: Case) -> tuple[Any, Any]:
    """Predict and update; random numbers go on from where the state's are."""
    return case.one.update(case.one.predict(copy.deepcopy(case.state), case.motion), case.z, case.sensor)


def arrays(value: Any) -> dict[str, Any]:
    """All arrays of a state by name, those of mixtures within too."""
    parts = {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if f.name != "rng"}
    within = {f"{k}.{n}": a for k, v in parts.items() if isinstance(v, Mixture) for n, a in arrays(v).items()}
    return {k: np.asarray(v) for k, v in parts.items() if not isinstance(v, Mixture)} | within


def state_moments(state: Any) -> Any:
    return moments(state) if isinstance(state, Mixture) else state.moments


def run(value: Any, at: int) -> Any:
    """Run `at` of a batch, as a batch of one."""
    one = slice(at, at + 1)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.replace(
            value, **{f.name: run(getattr(value, f.name), at) for f in dataclasses.fields(value)}
        )
    if isinstance(value, Scan):
        return Scan(value.values[one], value.present[one])
    if isinstance(value, list):
        return [run(v, at) for v in value]
    return value[one] if isinstance(value, np.ndarray) and value.shape[:1] == (RUNS,) else value


def test_the_rooms_example_runs() -> None:
    assert doctest.testmod(filters).attempted > 5
    assert doctest.testmod(filters).failed == 0


def test_no_filter_is_left_out() -> None:
    found = set()
    for info in pkgutil.iter_modules(filters.__path__):
        module = importlib.import_module(f"track_fusion.filters.{info.name}")
        for name, cls in vars(module).items():
            own = inspect.isclass(cls) and cls.__module__ == module.__name__ and not inspect.isabstract(cls)
            if own and hasattr(cls, "predict") and hasattr(cls, "update") and not getattr(cls, "_is_protocol", False):
                found.add(name)
    assert found == {type(case.one).__name__ for case in CASES.values()}


@pytest.mark.parametrize("key", CASES)
def test_a_step_leaves_its_state_as_it_was_and_gives_the_same_again(key: str) -> None:
    case = CASES[key]
    before = copy.deepcopy(arrays(case.state))
    first, second = stepped(case)[0], stepped(case)[0]
    for name, values in arrays(case.state).items():
        np.testing.assert_array_equal(values, before[name])
    assert arrays(first).keys() == before.keys()
    for name, values in arrays(first).items():
        np.testing.assert_array_equal(values, arrays(second)[name])
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(first, next(iter(before)).partition(".")[0], None)


@pytest.mark.parametrize("key", CASES)
def test_moments_are_those_of_densities(key: str) -> None:
    state, learned = stepped(CASES[key])
    mean, cov = state_moments(state)
    assert (mean.shape, cov.shape) == ((RUNS, 4), (RUNS, 4, 4))
    np.testing.assert_array_equal(cov, np.swapaxes(cov, 1, 2))
    assert (np.linalg.eigvalsh(cov) > 0).all()
    if hasattr(learned, "log_likelihood"):
        assert learned.log_likelihood.shape == (RUNS,)
        assert np.isfinite(learned.log_likelihood).all()


@pytest.mark.parametrize("key", [key for key in CASES if key != "particle"])
def test_a_batch_is_a_loop(key: str) -> None:
    """Of particles: test_particle.py, where each run has a stream."""
    case = CASES[key]
    whole = state_moments(stepped(case)[0])
    rtol = 1e-6 if key == "negative_information" else 1e-9  # its iterations end when all of a batch have settled
    for at in range(RUNS):
        alone = state_moments(stepped(case._replace(state=run(case.state, at), z=run(case.z, at)))[0])
        for one, every in zip(alone, whole, strict=True):
            np.testing.assert_allclose(one[0], every[at], rtol=rtol, atol=1e-9)


@pytest.mark.parametrize("key", TRACKS)
def test_a_filter_of_tracks_begins_with_a_gaussian_and_adopts_moments(key: str) -> None:
    case, density = CASES[key], Gaussian(MEAN + 1.0, 2.0 * COV)
    exact = key != "particle"
    for state, wanted in ((case.state, (MEAN, COV)), (case.one.adopt(stepped(case)[0], density), density.moments)):
        for own, given in zip(state.moments, wanted, strict=True):
            np.testing.assert_allclose(own, given, rtol=1e-12 if exact else 0.0, atol=0.0 if exact else 30.0)
    if not exact:
        joined = case.one.adopt(
            case.state, Particles(np.tile(MEAN[:, None], (1, 7, 1)), np.full((RUNS, 7), -np.log(7)))
        )
        np.testing.assert_array_equal(joined.points, np.tile(MEAN[:, None], (1, 50, 1)))


@pytest.mark.parametrize("key", ["extended", "unscented", "cubature", "square_root_cubature", "student_t"])
def test_runs_may_share_one_covariance(key: str) -> None:
    case = CASES[key]
    shared = stepped(case._replace(state=case.one.begin(MEAN, COV[:1])))[0].moments
    for one, every in zip(shared, stepped(case)[0].moments, strict=True):
        np.testing.assert_allclose(one, every, rtol=1e-12)


def test_a_kalman_filter_keeps_a_shared_covariance_shared() -> None:
    case = CASES["kalman"]
    mean, cov = stepped(case._replace(state=case.one.begin(MEAN, COV[:1])))[0].moments
    assert (mean.shape, cov.shape) == ((RUNS, 4), (1, 4, 4))
    with pytest.raises(ValueError, match="The 'transition' of a Kalman filter must be linear. Got one without"):
        Kalman().predict(case.state, dataclasses.replace(MOTION, matrix=None))
