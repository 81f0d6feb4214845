"""Cubic-regularised policy Newton algorithms for Stable-Baselines3.

``CRPN`` and ``ACRPN`` are Stable-Baselines3 algorithms, ``MlpPolicy``, ``CnnPolicy`` and
``MultiInputPolicy`` its policies; ``PAPER`` holds the settings at which they
are Algorithms 1 and 2 of Maniyar et al., AISTATS 2024 (the latter with ``subsolver_steps=None``).
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
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

# Where the public names are. They are imported when they are asked for, so that the command line
# answers without PyTorch.
_POLICIES = "stable_baselines3.common.policies"
_LAZY = {
    "ACRPN": ("sb3_crpn.acrpn", "ACRPN"),
    "CRPN": ("sb3_crpn.crpn", "CRPN"),
    "CnnPolicy": (_POLICIES, "ActorCriticCnnPolicy"),
    "MlpPolicy": (_POLICIES, "ActorCriticPolicy"),
    "MultiInputPolicy": (_POLICIES, "MultiInputActorCriticPolicy"),
}


def __getattr__(name: str) -> Any:
    """Import a public name."""
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _LAZY[name]
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    """Return the names that are here, those not imported yet included."""
    return sorted({*globals(), *_LAZY})
