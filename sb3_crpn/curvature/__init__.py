"""From episodes to the gradient, the Hessian and the Fisher matrix, and the local cubic model."""

from sb3_crpn.curvature.estimate import CurvatureEstimate, estimate_curvature
from sb3_crpn.curvature.local_model import FullModel, LocalModel, SubspaceModel, subspace_model
from sb3_crpn.curvature.metric import METRICS, Euclidean, Fisher, Metric
from sb3_crpn.curvature.operator import GroupedOperator
from sb3_crpn.curvature.pair_weights import (
    HESSIAN_ESTIMATORS,
    Causal,
    HessianEstimator,
    Trajectory,
)
from sb3_crpn.curvature.registry import Registry
from sb3_crpn.curvature.shrinkage import (
    SHRINKAGES,
    Constant,
    JamesStein,
    Shrinkage,
    resolve_shrinkage,
)

__all__ = [
    "HESSIAN_ESTIMATORS",
    "METRICS",
    "SHRINKAGES",
    "Causal",
    "Constant",
    "CurvatureEstimate",
    "Euclidean",
    "Fisher",
    "FullModel",
    "GroupedOperator",
    "HessianEstimator",
    "JamesStein",
    "LocalModel",
    "Metric",
    "Registry",
    "Shrinkage",
    "SubspaceModel",
    "Trajectory",
    "estimate_curvature",
    "resolve_shrinkage",
    "subspace_model",
]
