"""The rules that Chen and Zhou 2022 compare, by the paper's names, and MHDP-E with the criterion as printed."""

from __future__ import annotations

from track_fusion.study.rule_choice import RuleChoice

DCI = RuleChoice.of("covariance_intersection", criterion="det")
FCI = RuleChoice.of("fast_covariance_intersection")
KLA = RuleChoice.of("covariance_intersection", "uniform", criterion="uniform")
GP = RuleChoice.of("geodesic_projection")
QMMHD = RuleChoice.of("quasi_minimal_manhattan")
MHDP_E = RuleChoice.of("mhdp_explicit")
MHDP_I = RuleChoice.of("mhdp_iterative")
UNSQUARED = RuleChoice.of("mhdp_explicit", "unsquared", criterion="unsquared")
