"""Parameter dataclasses: what they accept, and the exact words in which they refuse."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from track_fusion.params import ParameterError, Params, Spec, from_dict, nearest, param, specs, unknown_name_error


@dataclasses.dataclass(frozen=True)
class Example(Params):
    """One parameter of each kind."""

    gate_probability: float = param(0.99, "share of true pairs kept", low=0.0, high=1.0)
    max_coast_s: float = param(5.0, "longest coast", unit="s", low=0.0, strict=True)
    offset_m: float = param(0.0, "any number", unit="m")
    runs: int = param(10, "how many", low=1, high=1000)
    autostart: bool = param(True, "start by itself")
    frame: str = param("map", "frame of the output")
    criterion: str = param("det", "what is minimised", choices=("det", "trace", "uniform"))
    weights: tuple[float, ...] = param((), "weights", low=0.0, high=1.0, kind=float)
    threshold: tuple[int, ...] = param((2, 3), "[M, N]", low=1)
    sources: tuple[str, ...] = param(("a",), "names")
    modes: tuple[str, ...] = param(("fast",), "modes", choices=("fast", "safe"))


def _refusal(**values: Any) -> str:
    with pytest.raises(ParameterError) as caught:
        Example(**values)
    return str(caught.value)


def test_defaults_are_valid_and_kept() -> None:
    example = Example()
    assert (example.gate_probability, example.runs, example.weights) == (0.99, 10, ())
    assert from_dict(Example, {}) == example


@pytest.mark.parametrize(
    ("values", "kept"),
    [
        ({"gate_probability": 1}, 1.0),  # YAML writes a whole number without its point
        ({"gate_probability": 0.0}, 0.0),
        ({"gate_probability": np.float64(0.5)}, 0.5),
        ({"runs": np.int64(7)}, 7),
        ({"autostart": np.bool_(False)}, False),
        ({"offset_m": -math.inf}, -math.inf),  # no limit: infinity is a number
        ({"weights": [1, 0]}, (1.0, 0.0)),
        ({"weights": np.array([0.25, 0.75])}, (0.25, 0.75)),
        ({"threshold": (3, 5)}, (3, 5)),
        ({"sources": []}, ()),
        ({"modes": ["safe", "fast"]}, ("safe", "fast")),
    ],
)
def test_values_take_their_declared_type(values: dict[str, Any], kept: Any) -> None:
    (name,) = values
    value = getattr(Example(**values), name)
    assert value == kept
    assert type(value) is type(kept)
    if isinstance(kept, tuple):
        assert [type(v) for v in value] == [type(v) for v in kept]


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"gate_probability": 1.5}, "The 'gate_probability' parameter must be a number >= 0 and <= 1. Got 1.5."),
        ({"gate_probability": math.nan}, "The 'gate_probability' parameter must be a number >= 0 and <= 1. Got nan."),
        ({"gate_probability": "0.9"}, "The 'gate_probability' parameter must be a number >= 0 and <= 1. Got '0.9'."),
        ({"gate_probability": True}, "The 'gate_probability' parameter must be a number >= 0 and <= 1. Got True."),
        ({"max_coast_s": 0.0}, "The 'max_coast_s' parameter must be a number > 0. Got 0.0."),
        ({"offset_m": math.nan}, "The 'offset_m' parameter must be a number. Got nan."),
        ({"offset_m": None}, "The 'offset_m' parameter must be a number. Got None."),
        ({"runs": 2.0}, "The 'runs' parameter must be an integer >= 1 and <= 1000. Got 2.0."),
        ({"runs": True}, "The 'runs' parameter must be an integer >= 1 and <= 1000. Got True."),
        ({"runs": 0}, "The 'runs' parameter must be an integer >= 1 and <= 1000. Got 0."),
        ({"autostart": 1}, "The 'autostart' parameter must be true or false. Got 1."),
        ({"frame": 3}, "The 'frame' parameter must be a string. Got 3."),
        (
            {"criterion": "trac"},
            "The 'criterion' parameter must be one of 'det', 'trace', 'uniform'. Got 'trac'. Did you mean 'trace'?",
        ),
        ({"criterion": 1}, "The 'criterion' parameter must be one of 'det', 'trace', 'uniform'. Got 1."),
        ({"weights": (0.5, -0.5)}, "The 'weights' parameter must be a list of numbers >= 0 and <= 1. Got (0.5, -0.5)."),
        ({"weights": 0.5}, "The 'weights' parameter must be a list of numbers >= 0 and <= 1. Got 0.5."),
        ({"weights": "0.5"}, "The 'weights' parameter must be a list of numbers >= 0 and <= 1. Got '0.5'."),
        ({"threshold": (2.5, 3)}, "The 'threshold' parameter must be a list of integers >= 1. Got (2.5, 3)."),
        ({"sources": "left"}, "The 'sources' parameter must be a list of strings. Got 'left'."),
        (
            {"modes": ("fats",)},
            "The 'modes' parameter must be a list out of 'fast', 'safe'. Got ('fats',). Did you mean 'fast'?",
        ),
    ],
)
def test_refusals_name_the_parameter_the_limit_and_the_value(values: dict[str, Any], text: str) -> None:
    assert _refusal(**values) == text


def test_misspelt_names_are_refused_with_the_nearest_and_the_list() -> None:
    with pytest.raises(ParameterError) as caught:
        from_dict(Example, {"max_coast": 3.0})
    assert str(caught.value) == (
        "Unknown parameter 'max_coast'. Did you mean 'max_coast_s'? Valid: autostart, criterion, frame, "
        "gate_probability, max_coast_s, modes, offset_m, runs, sources, threshold, weights."
    )
    text = str(unknown_name_error("qqq", [], "scenario"))
    assert text == "Unknown scenario 'qqq'. Valid: none."


def test_many_names_are_listed_only_where_none_is_near() -> None:
    many = [f"parameter_{i:02d}" for i in range(41)]
    assert (
        str(unknown_name_error("paramter_07", many)) == "Unknown parameter 'paramter_07'. Did you mean 'parameter_07'?"
    )
    assert str(unknown_name_error("qqq", many)).endswith("parameter_40.")
    assert "Valid:" in str(unknown_name_error("paramter_07", many[:40]))


def test_nearest_says_nothing_when_nothing_is_near() -> None:
    assert nearest("zzz", ["det", "trace"]) == ""
    assert nearest("tarce", ["det", "trace"]) == " Did you mean 'trace'?"


def test_a_good_name_with_a_bad_value_is_refused_as_such() -> None:
    with pytest.raises(ParameterError, match="The 'runs' parameter must be an integer"):
        from_dict(Example, {"runs": -1})


def test_parameters_cannot_be_changed_behind_the_check() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        Example().runs = 0  # type: ignore[misc]
    with pytest.raises(ParameterError):
        dataclasses.replace(Example(), runs=0)


def test_specs_tell_what_descriptors_are_made_of() -> None:
    found = specs(Example)
    assert list(found) == [f.name for f in dataclasses.fields(Example)]
    assert found["max_coast_s"] == (Spec(float, "longest coast", "s", low=0.0, strict=True), 5.0)
    assert found["weights"][0].kind is float
    assert found["weights"][0].sequence
    assert found["threshold"] == (Spec(int, "[M, N]", low=1, sequence=True), (2, 3))
    assert specs(Example()) == found


@pytest.mark.parametrize("name", specs(Example))
def test_every_default_of_an_empty_or_full_list_survives_its_own_check(name: str) -> None:
    default = specs(Example)[name][1]
    assert getattr(from_dict(Example, {name: default}), name) == default
