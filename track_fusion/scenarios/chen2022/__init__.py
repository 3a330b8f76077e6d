"""The published studies of one paper."""

PAPER = "Chen and Zhou, Multisensor Estimation Fusion on Statistical Manifold"
