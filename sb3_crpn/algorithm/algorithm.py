"""PolicyNewtonAlgorithm: the arguments that CRPN and ACRPN have in common."""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import (
    ActorCriticCnnPolicy,
    ActorCriticPolicy,
    BasePolicy,
    MultiInputActorCriticPolicy,
)
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback

from sb3_crpn.algorithm.critic import fuse
from sb3_crpn.algorithm.declaration import check_setting, check_settings, configured
from sb3_crpn.algorithm.random_state import RandomState
from sb3_crpn.algorithm.settings import LEARNING_RATE, CheckedSchedule
from sb3_crpn.algorithm.update import PolicyNewtonUpdate
from sb3_crpn.checks import POSITIVE, not_allowed
from sb3_crpn.distributed import rank
from sb3_crpn.episodes import (
    DictEpisodeRolloutBuffer,
    EpisodeRolloutBuffer,
    Replay,
)
from sb3_crpn.parameters import ActorParameters

Self = TypeVar("Self", bound="PolicyNewtonAlgorithm")


@configured
class PolicyNewtonAlgorithm(RandomState, PolicyNewtonUpdate):
    """Base of the cubic-regularised policy Newton algorithms.

    Each update minimises the cubic model of the cost J(θ) = -E[Σ_h γ^h r_h],

        m(s) = g·s + ½ sᵀ(ωH)s + (α/6)‖s‖³_M,

    with g and H estimated from whole episodes and M the Euclidean or the Fisher metric.

    {parameters}

    Raises
    ------
    ValueError
        An argument is out of range; the message names it, its value and what is allowed.

    References
    ----------
    Maniyar, Prashanth L.A., Mondal, Bhatnagar, A Cubic-regularized Policy Newton Algorithm for
    Reinforcement Learning, AISTATS 2024.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": ActorCriticPolicy,
        "CnnPolicy": ActorCriticCnnPolicy,
        "MultiInputPolicy": MultiInputActorCriticPolicy,
    }

    def __post_init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str | None,
        rollout_buffer_kwargs: dict[str, Any] | None,
        stats_window_size: int,
        policy_kwargs: dict[str, Any] | None,
        device: torch.device | str,
        _init_setup_model: bool,
    ) -> None:
        check = partial(check_setting, self)
        check_settings(self)
        check("_init_setup_model", _init_setup_model)
        if env is None and _init_setup_model:
            raise not_allowed(
                f"{type(self).__name__}: env", env, "an environment or a registered id"
            )
        if check("policy", policy) not in self.policy_aliases and isinstance(policy, str):
            names = ", ".join(f'"{name}"' for name in self.policy_aliases)
            raise not_allowed(f"{type(self).__name__}: policy", policy, f"{names} or a class")
        super().__init__(
            policy,
            env,  # type: ignore[arg-type] # None where a file is loaded
            learning_rate=self.learning_rate,
            n_steps=self.n_steps,
            gamma=self.gamma,
            gae_lambda=self.gae_lambda,
            ent_coef=0.0,
            vf_coef=0.0,
            max_grad_norm=0.0,
            use_sde=self.use_sde,
            sde_sample_freq=self.sde_sample_freq,
            rollout_buffer_class=self.rollout_buffer_class,
            rollout_buffer_kwargs=check("rollout_buffer_kwargs", rollout_buffer_kwargs),
            stats_window_size=check("stats_window_size", stats_window_size),
            tensorboard_log=self.tensorboard_log,
            policy_kwargs=check("policy_kwargs", policy_kwargs),
            verbose=self.verbose if rank() == 0 else 0,
            seed=self.seed,
            device=check("device", device),
            _init_setup_model=False,
            supported_action_spaces=(
                spaces.Box,
                spaces.Discrete,
                spaces.MultiDiscrete,
                spaces.MultiBinary,
            ),
        )
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        check_settings(self)
        if self.rollout_buffer_class is None:
            is_dict = isinstance(self.observation_space, spaces.Dict)
            self.rollout_buffer_class = (
                DictEpisodeRolloutBuffer if is_dict else EpisodeRolloutBuffer
            )
        super()._setup_model()
        fuse(self.policy.optimizer)
        self.alpha_schedule = CheckedSchedule(f"{type(self).__name__}: alpha", self.alpha, POSITIVE)
        self.replay = Replay(self.n_reused_rollouts, self.gamma, self.gae_lambda)
        self.actor = self._find_actor()

    def _setup_lr_schedule(self) -> None:
        name = f"{type(self).__name__}: learning_rate"
        self.lr_schedule = CheckedSchedule(name, self.learning_rate, LEARNING_RATE)

    def _find_actor(self) -> ActorParameters:
        """Select the parameters that log π depends on, by gradient reachability."""
        self.policy.set_training_mode(False)
        zeros = _zero_observation(self.observation_space)
        distribution = self.policy.get_distribution(self.policy.obs_to_tensor(zeros)[0])
        log_prob = distribution.log_prob(distribution.mode().detach())
        return ActorParameters.reachable(self.policy, log_prob)

    def _excluded_save_params(self) -> list[str]:
        own = ["actor", "alpha_schedule", "lr_schedule", "replay", "_collecting", "_statistics"]
        return [*super()._excluded_save_params(), *own]

    def learn(
        self: Self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Train for at least ``total_timesteps``, as SB3's algorithms do."""
        self.replay.clear()  # the environment may be another one
        return super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,
            tb_log_name=tb_log_name or type(self).__name__,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )


def _zero_observation(space: spaces.Space[Any]) -> Any:
    """Return an observation of zeros."""
    if isinstance(space, spaces.Dict):
        return {key: _zero_observation(subspace) for key, subspace in space.spaces.items()}
    return np.zeros(space.shape or (), dtype=space.dtype)
