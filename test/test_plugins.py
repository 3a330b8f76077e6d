"""What a registry holds, loads and refuses: track_fusion/plugins.py."""

from __future__ import annotations

import dataclasses
import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from package.packages import install

from track_fusion.params import ParameterError, Params, from_dict, param
from track_fusion.plugins import Registry, from_module

GROUP = "test_registry.words"


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of installed packages; what they import is forgotten afterwards."""
    monkeypatch.syspath_prepend(tmp_path)
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        del sys.modules[name]


def words() -> Registry[str]:
    """Our words, with those of the packages installed so far."""
    importlib.invalidate_caches()
    return Registry(GROUP, "word", str, {"tree": "a tree", "house": "a house"})


def test_ours_and_those_of_packages_are_found_by_key(site: Path) -> None:
    install(site, "sea-words", {GROUP: {"ship": "sea_words:SHIP"}}, {"sea_words": 'SHIP = "a ship"'})
    registry = words()
    assert list(registry) == ["tree", "house", "ship"]
    assert len(registry) == 3
    assert list(registry.own) == ["tree", "house"]
    assert "ship" in registry
    assert "boat" not in registry
    assert "sea_words" not in sys.modules  # names are known without importing
    assert registry["tree"] == "a tree"
    assert "sea_words" not in sys.modules
    assert registry["ship"] == "a ship"
    assert dict(registry) == {"tree": "a tree", "house": "a house", "ship": "a ship"}


def test_a_package_is_loaded_once(site: Path) -> None:
    counting = "import pathlib\nplace = pathlib.Path(__file__).with_name('count')\n" + (
        "place.write_text(place.read_text() + 'x' if place.exists() else 'x')\nSHIP = str(object())\n"
    )
    install(site, "sea-words", {GROUP: {"ship": "sea_words:SHIP"}}, {"sea_words": counting})
    registry = words()
    assert registry["ship"] is registry["ship"]
    assert (site / "count").read_text() == "x"


BROKEN = {
    "raise RuntimeError('no sea')": "RuntimeError: no sea",
    "import no_such_sea": "ModuleNotFoundError: No module named 'no_such_sea'",
    "SHIP = (": "SyntaxError: ",
    "BOAT = ''": "AttributeError: ",
}


@pytest.mark.parametrize("text", BROKEN)
def test_one_that_cannot_be_loaded_says_so_when_it_is_asked_for(site: Path, text: str) -> None:
    install(site, "sea-words", {GROUP: {"ship": "sea_words:SHIP"}}, {"sea_words": text})
    registry = words()
    assert registry["house"] == "a house"
    assert "ship" in registry
    with pytest.raises(ParameterError) as caught:
        registry["ship"]
    wanted = (
        f"The word 'ship' of the package 'sea-words' (entry point sea_words:SHIP in {GROUP}) cannot be loaded: "
        + BROKEN[text]
    )
    assert str(caught.value).startswith(wanted)


def test_one_of_another_kind_is_refused(site: Path) -> None:
    install(site, "sea-words", {GROUP: {"ship": "sea_words:SHIP"}}, {"sea_words": "SHIP = 3"})
    with pytest.raises(ParameterError, match=r"in test_registry.words\) must be a str of the key 'ship'. Got 3"):
        words()["ship"]


def test_one_whose_own_key_is_another_is_refused(site: Path) -> None:
    text = "class Word(str):\n    key = 'boat'\nSHIP = Word('a ship')"
    install(site, "sea-words", {GROUP: {"ship": "sea_words:SHIP"}}, {"sea_words": text})
    with pytest.raises(ParameterError, match="must be a str of the key 'ship'. Got one of the key 'boat'."):
        words()["ship"]


def test_a_key_that_is_taken_is_refused_with_the_names_of_both(site: Path) -> None:
    install(site, "sea-words", {GROUP: {"tree": "sea_words:TREE", "ship": "sea_words:SHIP"}},
            {"sea_words": 'SHIP = "a ship"\nTREE = "a mast"'})  # fmt: skip
    install(site, "air-words", {GROUP: {"ship": "air_words:SHIP"}}, {"air_words": "SHIP = 'an air ship'"})
    registry = words()
    with pytest.raises(ParameterError) as caught:
        registry["tree"]
    assert str(caught.value) == (
        "The word 'tree' must have a key of its own. Got it from track_fusion and "
        f"the package 'sea-words' (entry point sea_words:TREE in {GROUP})."
    )
    with pytest.raises(ParameterError) as caught:
        registry["ship"]
    for package in ("sea-words", "air-words"):
        assert f"the package '{package}'" in str(caught.value)
    assert registry["house"] == "a house"
    assert list(registry) == ["tree", "house", "ship"]


def test_a_misspelt_name_is_told_the_nearest_of_all(site: Path) -> None:
    install(site, "sea-words", {GROUP: {"ship": "sea_words:SHIP"}}, {"sea_words": "raise RuntimeError"})
    with pytest.raises(ParameterError) as caught:
        words()["shop"]
    assert str(caught.value) == "Unknown word 'shop'. Did you mean 'ship'? Valid: house, ship, tree."


def test_a_parameter_may_choose_from_a_registry(site: Path) -> None:
    install(site, "sea-words", {GROUP: {"ship": "sea_words:SHIP"}}, {"sea_words": "raise RuntimeError"})

    choice: Any = dataclasses.make_dataclass(
        "choice", [("word", str, param("tree", "a word", choices=words()))], bases=(Params,), frozen=True
    )
    assert from_dict(choice, {"word": "ship"}).word == "ship"  # choosing does not load
    with pytest.raises(ParameterError) as caught:
        from_dict(choice, {"word": "shop"})
    assert str(caught.value) == (
        "The 'word' parameter must be one of 'tree', 'house', 'ship'. Got 'shop'. Did you mean 'ship'?"
    )


def test_what_a_user_adds_needs_a_key_of_its_own(site: Path) -> None:
    install(site, "sea-words", {GROUP: {"ship": "sea_words:SHIP"}}, {"sea_words": "SHIP = 'a ship'"})
    registry = words()
    registry.add("hill", "a hill", "./hill.py")
    registry.add("hill", registry["hill"], "./hill.py")
    registry.add("ship", registry["ship"], "sea_words:SHIP")
    assert registry["hill"] == "a hill"
    for key in ("tree", "ship", "hill"):
        with pytest.raises(ParameterError, match=f"The word of ./a.py must have a key of its own. Got '{key}', which"):
            registry.add(key, "another", "./a.py")


@pytest.mark.parametrize("name", ["no_such_module:X", "json:no_such_name", "1x:y"])
def test_module_and_attribute_that_are_not_there(name: str) -> None:
    with pytest.raises(ParameterError, match=f"^There is no '{name}': "):
        from_module(name, str)


def test_module_and_attribute_of_another_kind() -> None:
    assert from_module("sys:version", str) == sys.version
    with pytest.raises(ParameterError, match=r"^'sys:maxsize' must be a str. Got \d+.$"):
        from_module("sys:maxsize", str)
