"""Ways to choose fusion weights, one a function.

Each takes a flat batch of K Gaussian tracks, mean (B, K, n) and cov (B, K, n, n), and returns a Solution with weights
(B, K).
"""
