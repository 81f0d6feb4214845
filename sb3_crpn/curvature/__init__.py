"""From episodes to the gradient, the Hessian and the Fisher matrix, and the local cubic model."""

from sb3_crpn.curvature.estimate import CurvatureEstimate, EpisodeOperator, estimate_curvature
from sb3_crpn.curvature.local_model import LocalModel, full_model, projected_model
from sb3_crpn.curvature.scores import PairWeights

__all__ = [
    "CurvatureEstimate",
    "EpisodeOperator",
    "LocalModel",
    "PairWeights",
    "estimate_curvature",
    "full_model",
    "projected_model",
]
