"""The policy, the environment and the α of the model that a certificate is for."""

from __future__ import annotations

import gymnasium as gym
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_crpn.algorithm import PolicyNewtonAlgorithm
from sb3_crpn.checks import not_allowed, requires

ENVIRONMENT = requires(
    "an environment or a VecEnv", lambda value: isinstance(value, gym.Env | VecEnv)
)


def policy_of(model: OnPolicyAlgorithm) -> ActorCriticPolicy:
    """Return the model's policy, or raise ValueError if it is no feed-forward ActorCriticPolicy."""
    policy = getattr(model, "policy", None)
    if not isinstance(policy, ActorCriticPolicy) or hasattr(policy, "lstm_actor"):
        raise ValueError(
            f"certify_sosp: model={model!r} is not allowed, must be an on-policy model with a "
            f"feed-forward ActorCriticPolicy, not {type(policy).__name__}"
        )
    return policy


def environment_of(model: OnPolicyAlgorithm, env: GymEnv | None) -> VecEnv:
    """Return ``env`` wrapped by SB3, or the model's own environment if ``env`` is ``None``."""
    if env is not None:
        ENVIRONMENT("certify_sosp: env", env)
        env = model._wrap_env(env, monitor_wrapper=False)
        check_for_correct_spaces(env, model.observation_space, model.action_space)
        return env
    own = model.get_env()
    if own is None:
        raise not_allowed("certify_sosp: env", None, "given: the model has no environment")
    if _in_rollout(model):
        raise RuntimeError(
            "the model's environment is in the middle of a rollout: "
            "pass an environment of its own with env="
        )
    model._last_obs = None  # the next learn() resets the environment
    return own


def _in_rollout(model: OnPolicyAlgorithm) -> bool:
    """Return whether the model is in mid-rollout, where a reset would corrupt the rollout.

    SB3 has no flag for it. In mid-rollout its buffer is partly filled.
    """
    if isinstance(model, PolicyNewtonAlgorithm):
        return model._collecting
    started = model._last_obs is not None and model.num_timesteps > 0
    return started and not model.rollout_buffer.full


def paper_alpha(model: OnPolicyAlgorithm) -> float | None:
    """Return the current α of a model with the paper's cubic term; ``None`` for other models."""
    if not isinstance(model, PolicyNewtonAlgorithm):
        return None
    if model.target_kl is not None or model.metric != "euclidean":
        return None
    return model.alpha_schedule(model._current_progress_remaining)
