"""Who sends to whom, when."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Sequence

#: (sender, receiver)
Edge = tuple[str, str]
#: What is sent at one time, in the order in which each receiver fuses it.
Round = Sequence[Edge]


@dataclasses.dataclass(frozen=True)
class Schedule:
    """Rounds that take place, one after the other, at every `period`-th step.

    Attributes
    ----------
    rounds : tuple of Round
    period : int              steps from one communication to the next
    """

    rounds: tuple[Round, ...]
    period: int = 1

    def at(self, step: int) -> tuple[Round, ...]:
        """Return the rounds of this step, counted from 1."""
        return self.rounds if step % self.period == 0 else ()


def ring(names: Sequence[str]) -> Round:
    """Every peer sends to the next, the last to the first."""
    return [(a, b) for a, b in zip(names, (*names[1:], names[0]), strict=True)]


def star(hub: str, leaves: Iterable[str]) -> tuple[Edge, ...]:
    """Links of a hub with all others."""
    return tuple((leaf, hub) for leaf in leaves)


def sweep(links: Iterable[Edge], root: str) -> tuple[Round, ...]:
    """Rounds after which every peer of a tree has the news of all: towards the root, then back.

    Parameters
    ----------
    links : pairs of names    in either direction
    root : str

    Raises
    ------
    ValueError    links close a loop or do not all reach the root
    """
    links = tuple(links)
    neighbours = neighbours_on({name for link in links for name in link} | {root}, links)
    outward: list[Round] = []
    reached, front = {root}, [root]
    while front:
        edges = [(name, other) for name in front for other in neighbours[name] if other not in reached]
        front = [other for _, other in edges]
        reached |= set(front)
        outward += [edges] if edges else []
    if reached != neighbours.keys():
        raise ValueError(
            f"The links must join all peers. Got none from '{root}' to '{min(neighbours.keys() - reached)}'."
        )
    inward = [[(child, parent) for parent, child in edges] for edges in reversed(outward)]
    return (*inward, *outward)


def neighbours_on(names: Collection[str], links: Iterable[Edge]) -> dict[str, list[str]]:
    """List each peer's neighbours on a tree.

    Raises
    ------
    ValueError    a link names no peer, or links close a loop
    """
    neighbours: dict[str, list[str]] = {name: [] for name in names}
    group = {name: name for name in names}
    for a, b in links:
        check_edge(names, a, b)
        if group[a] == group[b]:
            raise ValueError(f"Exact fusion by channel filters needs a tree. Got a loop closed by {(a, b)}.")
        joined = group[b]
        group = {name: group[a] if root == joined else root for name, root in group.items()}
        neighbours[a].append(b)
        neighbours[b].append(a)
    return neighbours


def check_edge(names: Collection[str], sender: str, receiver: str) -> None:
    """Check that an edge joins two of these peers.

    Raises
    ------
    ValueError    a name is no peer's, or both are the same
    """
    for name in (sender, receiver):
        if name not in names:
            raise ValueError(f"An edge must name two peers out of {', '.join(sorted(names))}. Got '{name}'.")
    if sender == receiver:
        raise ValueError(f"A peer must not send to itself. Got {(sender, receiver)}.")
