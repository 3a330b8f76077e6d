"""Channel filters: what both ends of a link contain, so that fusion counts it once."""

from __future__ import annotations

import dataclasses
from typing import Generic, TypeVar

from track_fusion.peers.fuse import Fuse

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Channel(Generic[T]):
    """One end of a link: the common information of both ends, and the number of rounds that used the link."""

    common: T
    rounds: int = 0

    def after(self, own: T, heard: T | None, sent: bool, first: bool, fuse: Fuse[T]) -> Channel[T]:
        """Return the channel after a round in which something was sent over it: it contains what was common before.

        Parameters
        ----------
        own : T              what this end held before the round, which it `sent` or not
        heard : T or None    what the other end sent, if it did
        first : bool         whether this end is the first in an order that both agree upon, so that rules that sample
                             give both the same
        """
        if heard is None:
            common = own
        elif not sent:
            common = heard
        else:
            one, other = (own, heard) if first else (heard, own)
            common = fuse(one, other, self.common, self.rounds)
        return Channel(common, self.rounds + 1)
