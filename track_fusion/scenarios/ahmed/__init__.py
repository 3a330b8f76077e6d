"""The published studies of one paper."""

PAPER = "Ahmed, Decentralized Gaussian Mixture Fusion through Unified Quotient Approximations"
