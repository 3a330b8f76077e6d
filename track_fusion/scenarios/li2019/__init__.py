"""The published studies of one paper."""

PAPER = (
    "Li et al., Second Order Statistics Analysis and Comparison between Arithmetic and Geometric Average Fusion, 2019"
)
