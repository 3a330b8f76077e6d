"""How a peer fuses one message."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypeVar

import numpy as np

from track_fusion.densities.mixture.mixture import Mixture, stacked
from track_fusion.params import Params
from track_fusion.rules import Rule, SourceTracks

T = TypeVar("T")


class Fuse(Protocol[T]):
    """How one message is fused."""

    def __call__(self, own: T, heard: T, common: T | None, count: int) -> T:
        """Fuse what a peer holds with what it heard.

        Parameters
        ----------
        own, heard : T         densities
        common : T or None     what both contain; None = not known
        count : int            how many messages were fused here before: for rules that draw random numbers
        """


def by_rule(rule: Rule, params: Params | None = None, seed: int = 0, periods: Sequence[float] = ()) -> Fuse[Mixture]:
    """Fuse by one of the rules; Gaussian tracks are mixtures of one component, (..., 1).

    Parameters
    ----------
    rule : Rule        any that needs nothing but the tracks and, with channels, their common information;
                       Gaussian rules fuse the moments of mixtures
    params : Params    None = the rule's defaults
    seed : int         of rules that draw random numbers: the k-th message of a peer meets the k-th stream
    periods : (n,)     of axes that wrap, infinite for the others; empty: none wraps

    Raises
    ------
    ValueError    the rule needs what peers do not exchange; on fusing: it needs common information, and there is
                  no channel, or there is one, and it would not use it
    """
    params = rule.params() if params is None else params
    foreign = [name for name in rule.needed(params) if name != "common"]
    if foreign:
        raise ValueError(f"The rule '{rule.key}' needs '{foreign[0]}', which peers do not exchange.")
    exact = "common" in rule.needed(params)

    def fuse(own: Mixture, heard: Mixture, common: Mixture | None, count: int) -> Mixture:
        if exact != (common is not None):
            state = "needs" if exact else "makes no use of"
            raise ValueError(f"The rule '{rule.key}' {state} the common information of a channel filter.")
        extras = {"seed": np.random.default_rng([seed, count]), "common": common}
        used = {k: v for k, v in extras.items() if k in (*rule.needed(params), *rule.optional)}
        return rule.apply(SourceTracks.of(stacked(own, heard), periods, **used), params).density

    return fuse
