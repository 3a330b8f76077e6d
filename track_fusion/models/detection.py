"""What a detector says of where a target is: probabilities of classes by a softmax of linear functions."""

from __future__ import annotations

import dataclasses

import numpy as np

from track_fusion.linalg import Array
from track_fusion.tracks import StateLayout


@dataclasses.dataclass(frozen=True)
class SoftmaxDetector:
    """P(class c | x) = exp(w_c'x + b_c) / sum over classes.

    Each class' region is convex; its edges are soft, the larger the weights the harder.

    Attributes
    ----------
    weight : (C, n)    w, per unit of each axis
    bias : (C,)        b
    """

    weight: Array
    bias: Array

    @classmethod
    def view_cone(
        cls,
        layout: StateLayout,
        location: tuple[float, float],
        heading_rad: float,
        reach_m: float,
        half_angle_rad: float,
        steepness: float,
    ) -> SoftmaxDetector:
        """A camera's triangle of view: class 0 inside, classes 1 to 3 beyond its left, right and far edge.

        Parameters
        ----------
        layout : StateLayout    has axes x and y
        location                its tip, metres
        heading_rad             of its axis, from x towards y
        reach_m                 distance of the far edge along the axis
        half_angle_rad          between axis and side edges, < pi / 2
        steepness               1/m: outside, the odds against "inside" grow e-fold in 1/steepness metres
        """
        sides = heading_rad + half_angle_rad, heading_rad - half_angle_rad
        normals = np.array([
            [-np.sin(sides[0]), np.cos(sides[0])],
            [np.sin(sides[1]), -np.cos(sides[1])],
            [np.cos(heading_rad), np.sin(heading_rad)],
        ])  # fmt: skip
        bias = -normals @ np.asarray(location) - np.array([0.0, 0.0, reach_m])
        weight = np.zeros((4, layout.size))
        weight[1:, list(layout.indices(("x", "y")))] = steepness * normals
        return cls(weight, np.concatenate([[0.0], steepness * bias]))

    def log_probability(self, state: Array) -> Array:
        """Log-probability of each class, (..., n) -> (..., C)."""
        score = state @ self.weight.T + self.bias
        score = score - score.max(-1, keepdims=True)
        return np.asarray(score - np.log(np.exp(score).sum(-1, keepdims=True)))
