"""From episodes to the gradient, the Hessian and the Fisher matrix, and the local cubic model."""

from sb3_crpn.curvature.derivatives import PairWeights
from sb3_crpn.curvature.estimate import CurvatureEstimate, GroupedOperator, estimate_curvature
from sb3_crpn.curvature.local_model import LocalModel, full_model, projected_model

__all__ = [
    "CurvatureEstimate",
    "GroupedOperator",
    "LocalModel",
    "PairWeights",
    "estimate_curvature",
    "full_model",
    "projected_model",
]
