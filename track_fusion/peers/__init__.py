"""Decentralised fusion: peers that tell each other their densities, with or without memory of what they share.

A peer holds a density and fuses what others send, one message after the other. A round says who sends to whom at one
time; a schedule says when rounds take place. What is sent is always the density from before the round. No ROS here: a
node carries one `Peer` and calls `Peer.exchange`; a study calls `communicate` on all of them.

Consistency
-----------
* With channel filters (`on_tree`) a link remembers the common information of its two ends, and fusion divides by
  it: nothing is counted twice, however often peers talk. On a tree, without process noise, and when every message
  arrives, each density is exactly the one given all data whose news reached the peer; after a `sweep` that
  is the centralised one. Loops are refused: news that comes round two ways is in no single channel. Process noise is
  common to all peers, which channels know in part: then fusion is exact only for two peers that exchange at every
  step, and else an approximation, optimistic by a few per cent (NEES 1.05 on a chain of five). For mixtures: up to
  the rule's sampling and reduction.
* Without channels it depends on the rule. A conservative one (covariance intersection, for Gaussians) is consistent
  on any topology, loops included. Naive fusion counts whatever two peers share again with each message (data
  incest): two peers that start from one prior and exchange what they have already claim it twice; five peers after
  three sweeps over a tree claim less than a hundredth of their mean squared error.

Example
-------
Five nodes in a directed network, each node folding its senders, in order, onto its own estimate:

>>> import numpy as np
>>> from track_fusion.peers import Peer, by_rule, communicate, gaussian
>>> from track_fusion.rules import RULES
>>> draws = np.random.default_rng(0).standard_normal((5, 1000, 2))  # 1000 Monte Carlo runs at once
>>> peers = {f"S{i + 1}": Peer(gaussian(x, np.eye(2))) for i, x in enumerate(draws)}
>>> fuse = by_rule(RULES["covariance_intersection"])
>>> for sent in ([("S1", "S4"), ("S2", "S4")], [("S3", "S5"), ("S4", "S5")]):  # S4 <- S1, S2; then S5 <- S3, S4
...     peers = communicate(peers, sent, fuse)
>>> peers["S5"].moments[0].shape
(1000, 2)
"""

from track_fusion.densities.mixture.mixture import gaussian
from track_fusion.peers.channel import Channel
from track_fusion.peers.fuse import Fuse, by_rule
from track_fusion.peers.peer import Peer, communicate, on_tree
from track_fusion.peers.schedule import Edge, Round, Schedule, ring, star, sweep

__all__ = [
    "Channel",
    "Edge",
    "Fuse",
    "Peer",
    "Round",
    "Schedule",
    "by_rule",
    "communicate",
    "gaussian",
    "on_tree",
    "ring",
    "star",
    "sweep",
]
