"""Cubic-regularised policy Newton algorithms for Stable-Baselines3.

``CRPN`` and ``ACRPN`` are Stable-Baselines3 algorithms, ``MlpPolicy``, ``CnnPolicy`` and
``MultiInputPolicy`` its policies; ``PAPER`` holds the settings at which they
are Algorithms 1 and 2 of Maniyar et al., AISTATS 2024 (the latter with ``subsolver_steps=None``).
"""

from stable_baselines3.common.policies import ActorCriticCnnPolicy as CnnPolicy
from stable_baselines3.common.policies import ActorCriticPolicy as MlpPolicy
from stable_baselines3.common.policies import MultiInputActorCriticPolicy as MultiInputPolicy

from sb3_crpn.acrpn import ACRPN
from sb3_crpn.crpn import CRPN

__all__ = [
    "ACRPN",
    "CRPN",
    "PAPER",
    "CnnPolicy",
    "MlpPolicy",
    "MultiInputPolicy",
    "__version__",
]

__version__ = "0.1.0"

PAPER = {
    "n_reused_rollouts": 0,
    "target_kl": None,
    "metric": "euclidean",
    "hessian_estimator": "trajectory",
    "hessian_shrinkage": None,
    "baseline": False,
    "gae_lambda": 1.0,
    "normalize_advantage": False,
    "discount_visitation": True,
    "bootstrap_truncated": False,
}
