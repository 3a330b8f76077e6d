"""Random numbers that depend on who draws them, never on how a study is cut into batches or processes."""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from track_fusion.linalg import Array
from track_fusion.params import Params, param


def stream(seed: int, run: int, role: str) -> np.random.Generator:
    """Return the generator of one role ("truth", a sensor's or a filter's name) in one Monte Carlo run.

    Draw from it step by step: n draws of one step after another equal one draw of all steps.
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(run, zlib.crc32(role.encode()))))


class StreamPosition(NamedTuple):
    """Where a stream stands, as a value: the numbers of its bit generator, PCG64."""

    state: int
    increment: int
    has_half: int
    half: int

    @classmethod
    def of(cls, rng: np.random.Generator) -> StreamPosition:
        """Return where a generator stands."""
        held: Mapping[str, Any] = rng.bit_generator.state
        return cls(held["state"]["state"], held["state"]["inc"], held["has_uint32"], held["uinteger"])

    def generator(self) -> np.random.Generator:
        """Make a generator that goes on from here."""
        bits = np.random.PCG64(0)
        bits.state = {
            "bit_generator": "PCG64", "state": {"state": self.state, "inc": self.increment},
            "has_uint32": self.has_half, "uinteger": self.half,
        }  # fmt: skip
        return np.random.Generator(bits)


@dataclasses.dataclass(frozen=True)
class RandomParams(Params):
    """Whose random numbers are drawn: those of a stream of its own for each seed, run and role."""

    seed: int = param(0, "seed of the random streams", low=0)
    run: int = param(0, "index of the Monte Carlo run", low=0)
    role: str = param(
        "", "name of the stream; those who work together need different ones. Empty: made from the node's"
    )

    def stream(self) -> np.random.Generator:
        """Return the generator, at its beginning."""
        return stream(self.seed, self.run, self.role)


#: One generator for a single run, or one for each run of a batch, whose first leading axis counts the runs.
Generators = np.random.Generator | Sequence[np.random.Generator]


Draw = Callable[[np.random.Generator, tuple[int, ...]], Array]


def _drawn(
    rng: Generators, shape: tuple[int, ...], draw: Callable[[np.random.Generator, tuple[int, ...]], Array]
) -> Array:
    if isinstance(rng, np.random.Generator):
        return draw(rng, shape)
    if not shape or len(rng) != shape[0]:
        raise ValueError(f"There must be one generator for each of the runs, shape {shape[:1]}. Got {len(rng)}.")
    drawn = np.empty(shape)
    for row, one in zip(drawn, rng, strict=True):
        row[...] = draw(one, shape[1:])
    return drawn


def normals(rng: Generators, shape: tuple[int, ...]) -> Array:
    """Draw standard normals; with a sequence of generators each draws its own run, `shape[1:]`.

    Raises
    ------
    ValueError    not one generator for each run
    """
    return _drawn(rng, shape, lambda one, size: one.standard_normal(size))


def uniforms(rng: Generators, shape: tuple[int, ...]) -> Array:
    """Draw from [0, 1), as :func:`normals`."""
    return _drawn(rng, shape, lambda one, size: np.asarray(one.random(size)))


def exponentials(rng: Generators, shape: tuple[int, ...]) -> Array:
    """Draw standard exponentials, as :func:`normals`."""
    return _drawn(rng, shape, lambda one, size: one.standard_exponential(size))
