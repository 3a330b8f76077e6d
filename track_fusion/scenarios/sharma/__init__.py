"""The published studies of one paper."""

PAPER = "Sharma et al., Harmonic Mean Density Fusion in Distributed Tracking"
