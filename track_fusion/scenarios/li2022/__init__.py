"""The published studies of one paper."""

PAPER = "Li et al., Some Statistic and Information-theoretic Results on Arithmetic Average Density Fusion"
