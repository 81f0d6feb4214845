"""PolicyNewtonAlgorithm: the arguments that CRPN and ACRPN have in common."""

from __future__ import annotations

import io
import os
import pathlib
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import (
    ActorCriticCnnPolicy,
    ActorCriticPolicy,
    BasePolicy,
    MultiInputActorCriticPolicy,
)
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback

from sb3_crpn.algorithm.checkpoint import (
    load_random_state,
    read_random_state,
    replaced_in_one_go,
)
from sb3_crpn.algorithm.critic import fuse
from sb3_crpn.algorithm.declaration import check_setting, check_settings, configured
from sb3_crpn.algorithm.distributed_training import DistributedTraining
from sb3_crpn.algorithm.kl_control import KLControl
from sb3_crpn.algorithm.rollouts import warn_of_endless_episodes
from sb3_crpn.algorithm.settings import LEARNING_RATE, CheckedSchedule
from sb3_crpn.algorithm.update import PolicyNewtonUpdate
from sb3_crpn.checks import POSITIVE, not_allowed
from sb3_crpn.distributed import rank, rank_seed
from sb3_crpn.episodes import (
    TRACKERS,
    DictEpisodeRolloutBuffer,
    EpisodeRolloutBuffer,
    Replay,
    Tracker,
)
from sb3_crpn.episodes.observations import all_finite
from sb3_crpn.episodes.running_moments import RunningMoments
from sb3_crpn.parameters import ActorParameters
from sb3_crpn.policy import find_actor, find_actor_anywhere, to_tensor

Self = TypeVar("Self", bound="PolicyNewtonAlgorithm")


@configured
class PolicyNewtonAlgorithm(PolicyNewtonUpdate):
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
        self._actor: ActorParameters | None = None
        self._actor_among: Sequence[tuple[torch.Tensor, bool]] = ()
        self._rng = np.random.default_rng()
        self.kl_control = KLControl()
        self._saved_random_state: dict[str, Any] | None = None
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
        self.tracker: Tracker = (
            TRACKERS[self.rollout]() if isinstance(self.rollout, str) else self.rollout()
        )
        if not self.tracker.whole_episodes:
            for name in ("n_episodes", "n_hessian_episodes"):
                if (value := getattr(self, name)) is not None:
                    argument = f"{type(self).__name__}: {name}"
                    raise not_allowed(argument, value, "None where rollouts are of timesteps")
        if self.env is not None and self.tracker.whole_episodes and self.horizon is None:
            warn_of_endless_episodes(self.env)

    def _setup_lr_schedule(self) -> None:
        name = f"{type(self).__name__}: learning_rate"
        self.lr_schedule = CheckedSchedule(name, self.learning_rate, LEARNING_RATE)

    @property
    def actor(self) -> ActorParameters:
        """The parameters θ that log π depends on, looked for again where the policy has others.

        The policy, or layers of it, may be replaced, frozen or unfrozen at any time.
        """
        present = [(tensor, tensor.requires_grad) for tensor in self.policy.parameters()]
        if self._actor is None or not _same(present, self._actor_among):
            self.policy.set_training_mode(False)
            if self._last_obs is None:
                self._actor = find_actor_anywhere(self.policy, self.observation_space)
            else:
                self._actor = find_actor(self.policy, to_tensor(self.policy, self._last_obs))
            self._actor_among = present
        return self._actor

    def _excluded_save_params(self) -> list[str]:
        found = ["_actor", "_actor_among", "last_update"]
        derived = ["alpha_schedule", "lr_schedule", "replay", "tracker", "ranks", "_collecting"]
        return [*super()._excluded_save_params(), *found, *derived]

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed Python, NumPy, PyTorch, the environments and the model's own generator.

        Every rank but the first seeds them with a hash of ``seed`` and its number.
        """
        self._seed(None if seed is None else rank_seed(seed))

    def _seed(self, seed: int | None) -> None:
        super().set_random_seed(seed)
        self._rng = np.random.default_rng(seed)

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
        self.last_update = None
        with torch.enable_grad():
            return super().learn(
                total_timesteps=total_timesteps,
                callback=callback,
                log_interval=log_interval,
                tb_log_name=tb_log_name or type(self).__name__,
                reset_num_timesteps=reset_num_timesteps,
                progress_bar=progress_bar,
            )

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        state, self._saved_random_state = self._saved_random_state, None
        if self.seed is None or reset_num_timesteps:
            state = None
        if rank() > 0:
            callback, progress_bar = None, False
            self.set_logger(Logger(folder=None, output_formats=[]))
            if state is not None and self.seed is not None:
                self._seed(rank_seed(self.seed, self.num_timesteps))
        normalizer = self.get_vec_normalize_env()
        self.ranks = DistributedTraining(self.policy, normalizer)
        moments = None if normalizer is None else RunningMoments(normalizer)
        before = None if moments is None else moments.snapshot()
        total_timesteps, callback = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        if moments is not None and before is not None and not all_finite(self._last_obs):
            moments.restore(before)
        if state is not None and rank() == 0:
            load_random_state(state, self.device)
            self._rng = state["model"]
        return total_timesteps, self.ranks.callback(callback)

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Save all attributes, parameters and random states in a zip file; rank 0 alone does.

        A file of that name is replaced at the end, in one go: whatever happens in between leaves
        it intact. ``learn(reset_num_timesteps=False)`` of a loaded model with a seed restores the
        random states, so that it goes on as if it had not stopped; loading for evaluation touches
        nothing. The environments' own generators are theirs to save.
        """
        if rank() > 0:
            return
        self._saved_random_state = {**read_random_state(self.device), "model": self._rng}
        try:
            if not isinstance(path, str | os.PathLike):
                super().save(path, exclude, include)
                return
            file = path if pathlib.Path(path).suffix else f"{path}.zip"  # as SB3 does
            with replaced_in_one_go(file) as stream:
                super().save(stream, exclude, include)
        finally:
            self._saved_random_state = None


def _same(
    present: Sequence[tuple[torch.Tensor, bool]], earlier: Sequence[tuple[torch.Tensor, bool]]
) -> bool:
    return len(present) == len(earlier) and all(
        now is then and trainable == was_trainable
        for (now, trainable), (then, was_trainable) in zip(present, earlier, strict=True)
    )
