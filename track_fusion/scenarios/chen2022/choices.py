"""The rules that Chen and Zhou 2022 compare, by the paper's names, and MHDP-E with the criterion as printed."""

from __future__ import annotations

from track_fusion.rules.covariance_intersection import CovarianceIntersectionParams
from track_fusion.rules.fast_covariance_intersection import FastCovarianceIntersectionParams
from track_fusion.rules.geodesic_projection import GeodesicProjectionParams
from track_fusion.rules.mhdp_explicit import MhdpExplicitParams
from track_fusion.rules.mhdp_iterative import MhdpIterativeParams
from track_fusion.rules.quasi_minimal_manhattan import QuasiMinimalManhattanParams
from track_fusion.study.rule_choice import RuleChoice

DCI = RuleChoice("covariance_intersection", CovarianceIntersectionParams(criterion="det"))
FCI = RuleChoice("fast_covariance_intersection", FastCovarianceIntersectionParams())
KLA = RuleChoice("covariance_intersection", CovarianceIntersectionParams(criterion="uniform"), "uniform")
GP = RuleChoice("geodesic_projection", GeodesicProjectionParams())
QMMHD = RuleChoice("quasi_minimal_manhattan", QuasiMinimalManhattanParams())
MHDP_E = RuleChoice("mhdp_explicit", MhdpExplicitParams())
MHDP_I = RuleChoice("mhdp_iterative", MhdpIterativeParams())
UNSQUARED = RuleChoice("mhdp_explicit", MhdpExplicitParams(criterion="unsquared"), "unsquared")
