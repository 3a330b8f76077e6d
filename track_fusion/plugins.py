"""Things by key: our own, what other installed packages bring by entry points, and objects from a user's own file."""

from __future__ import annotations

import functools
import importlib.util
import pkgutil
import sys
from collections.abc import Iterator, Mapping
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TypeVar

from track_fusion.params import ParameterError, unknown_name_error

T = TypeVar("T")


class Registry(Mapping[str, T]):
    """Things by key: our own, and those that other installed packages bring by the entry points of a group.

    Names are read without importing anything. What a package brings is loaded, once, when its key is looked up: one
    that cannot be loaded, or whose key another has, is refused then and disturbs nobody else.

    Parameters
    ----------
    group : str      the group of entry points, such as "track_fusion.rules"; the name of an entry point is the key
    what : str       what the things are, for errors
    kind : type      their class; a `key` that they have must be that of the entry point
    own : mapping    ours

    Attributes
    ----------
    own : dict       ours, and those given by :meth:`add`
    group : str      as given
    """

    def __init__(self, group: str, what: str, kind: type[T], own: Mapping[str, T]) -> None:
        self.own = dict(own)
        self.group, self._what, self._kind = group, what, kind
        self._loaded: dict[str, T] = {}

    @functools.cached_property
    def _offers(self) -> Mapping[str, list[EntryPoint]]:
        offers: dict[str, list[EntryPoint]] = {}
        for point in entry_points(group=self.group):
            offers.setdefault(point.name, []).append(point)
        return offers

    def __iter__(self) -> Iterator[str]:
        return iter({**self.own, **self._offers})

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __contains__(self, key: object) -> bool:
        return key in self.own or key in self._offers

    def __getitem__(self, key: str) -> T:
        """Return the thing of a key.

        Raises
        ------
        ParameterError    there is none (the nearest key is given), several claim the key, or it cannot be loaded
        """
        offers = self._offers.get(key, ())
        if not offers and key not in self.own:
            raise unknown_name_error(key, self, self._what)
        claims = ["track_fusion"] * (key in self.own) + [_told(point) for point in offers]
        if len(claims) > 1:
            raise ParameterError(
                f"The {self._what} '{key}' must have a key of its own. Got it from {' and '.join(claims)}."
            )
        if not offers:
            return self.own[key]
        if key not in self._loaded:
            self._loaded[key] = self._load(offers[0])
        return self._loaded[key]

    def _load(self, point: EntryPoint) -> T:
        try:
            thing = point.load()
        except Exception as error:  # whatever a module does while it is imported
            raise ParameterError(
                f"The {self._what} '{point.name}' of {_told(point)} cannot be loaded: {type(error).__name__}: {error}"
            ) from error
        key = getattr(thing, "key", point.name)
        if not isinstance(thing, self._kind) or key != point.name:
            wanted = f"a {self._kind.__name__} of the key '{point.name}'"
            got = f"one of the key '{key}'" if isinstance(thing, self._kind) else repr(thing)
            raise ParameterError(f"The {self._what} '{point.name}' of {_told(point)} must be {wanted}. Got {got}.")
        return thing

    def add(self, key: str, thing: T, source: str) -> None:
        """Take in what a user's own file or module gives.

        Raises
        ------
        ParameterError    the key is that of another
        """
        if key not in self:
            self.own[key] = thing
        elif self[key] is not thing:
            raise ParameterError(
                f"The {self._what} of {source} must have a key of its own. Got '{key}', which is taken."
            )


def _told(point: EntryPoint) -> str:
    package = point.dist.name if point.dist else "an unknown package"
    return f"the package '{package}' (entry point {point.value} in {point.group})"


def is_path(name: str) -> bool:
    """Tell a file from a key."""
    return name.endswith(".py")


@functools.cache
def from_file(path: str, name: str, kind: type[T]) -> T:
    """Run a Python file, once, and return what it defines under a name.

    Raises
    ------
    ParameterError    there is no such file, or it does not define it
    """
    if not Path(path).is_file():
        raise ParameterError(f"There is no file '{path}'.")
    spec = importlib.util.spec_from_file_location(f"_given_{Path(path).stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return _of_kind(getattr(module, name, None), kind, f"The file '{path}' must define {name}, a")


def from_module(name: str, kind: type[T]) -> T:
    """Import `module:attribute`.

    Raises
    ------
    ParameterError    there is none, or it is something else
    """
    try:
        given = pkgutil.resolve_name(name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ParameterError(f"There is no '{name}': {error}") from error
    return _of_kind(given, kind, f"'{name}' must be a")


def _of_kind(given: object, kind: type[T], wanted: str) -> T:
    if not isinstance(given, kind):
        raise ParameterError(f"{wanted} {kind.__name__}. Got {given!r}.")
    return given
