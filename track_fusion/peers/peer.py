"""A peer as a value, and what becomes of peers that talk."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Generic, TypeVar

from track_fusion.densities.mixture.mixture import Mixture, moments
from track_fusion.linalg import Array
from track_fusion.peers.channel import Channel
from track_fusion.peers.fuse import Fuse
from track_fusion.peers.schedule import Edge, Round, check_edge, neighbours_on

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Peer(Generic[T]):
    """A member of a network.

    Attributes
    ----------
    density : T                     what it knows; usually a Mixture, of one component if Gaussian
    channels : mapping or None      neighbour -> Channel; None = common information is not tracked
    fused : int                     messages fused so far
    name : str                      of its own; matters with channels only
    """

    density: T
    channels: Mapping[str, Channel[T]] | None = None
    fused: int = 0
    name: str = ""

    def moved(self, move: Callable[[T], T]) -> Peer[T]:
        """Predict the density and, alike, the common information of every channel."""
        channels = self.channels and {
            n: dataclasses.replace(c, common=move(c.common)) for n, c in self.channels.items()
        }
        return dataclasses.replace(self, density=move(self.density), channels=channels)

    def updated(self, update: Callable[[T], T]) -> Peer[T]:
        """Condition the density on something that only this peer saw."""
        return dataclasses.replace(self, density=update(self.density))

    def exchange(self, sent_to: Collection[str], heard: Mapping[str, T], fuse: Fuse[T]) -> Peer[T]:
        """Take part in one round: having sent its density to some peers, fuse what others sent.

        Parameters
        ----------
        sent_to : names        to whom `density` went; they must have received it
        heard : name -> T      fused in this order
        fuse : Fuse

        Raises
        ------
        ValueError    common information is tracked, but not with one of them

        Notes         Both ends of a channel compute the same new common information: what one sent, or, if
                      both did, the fusion of the two.
        """
        channels, partners = self.channels, set(sent_to) | heard.keys()
        if channels is not None and partners - channels.keys():
            stranger = min(partners - channels.keys())
            raise ValueError(f"The peer '{self.name}' has no channel to '{stranger}': the tree lacks this link.")
        density, fused = self.density, self.fused
        for sender, message in heard.items():
            common = None if channels is None else channels[sender].common
            density, fused = fuse(density, message, common, fused), fused + 1
        if channels is not None:
            channels = dict(channels)
            for other in partners:
                first, sent = self.name < other, other in sent_to
                channels[other] = channels[other].after(self.density, heard.get(other), sent, first, fuse)
        return dataclasses.replace(self, density=density, fused=fused, channels=channels)

    @property
    def moments(self: Peer[Mixture]) -> tuple[Array, Array]:
        """Mean (..., n) and covariance (..., n, n) of the density, a Mixture."""
        return moments(self.density)


def on_tree(densities: Mapping[str, T], common: T, links: Iterable[Edge]) -> dict[str, Peer[T]]:
    """Make peers with channel filters on the links of a tree.

    Parameters
    ----------
    densities : name -> T    what each peer starts with
    common : T               what all of them contain at the start: the prior
    links : pairs of names   in either direction

    Raises
    ------
    ValueError    a link names no peer, or links close a loop: exact fusion needs a tree
    """
    neighbours = neighbours_on(densities, links)
    return {
        name: Peer(density, {other: Channel(common) for other in neighbours[name]}, name=name)
        for name, density in densities.items()
    }


def communicate(peers: Mapping[str, Peer[T]], sent: Round, fuse: Fuse[T]) -> dict[str, Peer[T]]:
    """Let peers exchange densities in one round: everyone sends what it held before the round.

    Parameters
    ----------
    peers : name -> Peer
    sent : pairs (sender, receiver)    each receiver fuses in this order
    fuse : Fuse

    Raises
    ------
    ValueError    a name is no peer's, a peer sends to itself, or an edge stands there twice

    Notes         News travels one link a round. Order matters within a receiver only.
    """
    outbox: dict[str, list[str]] = {name: [] for name in peers}
    inbox: dict[str, dict[str, T]] = {name: {} for name in peers}
    for sender, receiver in sent:
        check_edge(peers, sender, receiver)
        if sender in inbox[receiver]:
            raise ValueError(f"An edge must stand in a round once. Got {(sender, receiver)} twice.")
        outbox[sender].append(receiver)
        inbox[receiver][sender] = peers[sender].density
    return {
        name: peer.exchange(outbox[name], inbox[name], fuse) if outbox[name] or inbox[name] else peer
        for name, peer in peers.items()
    }
