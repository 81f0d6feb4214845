"""PolicyNewtonAlgorithm: what CRPN and ACRPN have in common."""

from __future__ import annotations

import inspect
import math
from dataclasses import fields, replace
from functools import partial
from typing import Any, ClassVar

import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv

from sb3_crpn.algorithm.checkpoint import ResumableAlgorithm
from sb3_crpn.algorithm.critic import fit_critic, fuse, has_own_parameters
from sb3_crpn.algorithm.declaration import check_setting, check_settings, configured
from sb3_crpn.algorithm.distributed_training import share_policy
from sb3_crpn.algorithm.evaluation import CandidateEvaluator
from sb3_crpn.algorithm.kl_control import KLControl
from sb3_crpn.algorithm.rollouts import TrainingRollouts, make_tracker
from sb3_crpn.algorithm.settings import LEARNING_RATE, PolicyNewtonSettings, checked_schedule
from sb3_crpn.algorithm.solvers import SubproblemSolver
from sb3_crpn.algorithm.statistics import UpdateStats
from sb3_crpn.algorithm.step import take_step
from sb3_crpn.algorithm.update import UpdateData, local_model, rollout_statistics, step_statistics
from sb3_crpn.checks import COUNT, FLAG, NONE, POSITIVE, not_allowed, requires
from sb3_crpn.curvature import HESSIAN_ESTIMATORS, CurvatureEstimate, estimate_curvature
from sb3_crpn.episodes import (
    DictEpisodeRolloutBuffer,
    EpisodeBatch,
    EpisodeRolloutBuffer,
    Replay,
)
from sb3_crpn.episodes.running_moments import RunningMoments
from sb3_crpn.parameters import ActorParameters
from sb3_crpn.policy import ActorFinder, unchanged_on_error

ACTION_SPACES = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
_VEC_ENV = requires("a VecEnv", lambda value: isinstance(value, VecEnv))


@configured
class PolicyNewtonAlgorithm(ResumableAlgorithm, PolicyNewtonSettings):
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

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = PPO.policy_aliases
    _collecting = False  # in the middle of a rollout

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
        self._actors = ActorFinder()
        self.kl_control = KLControl()
        self.rollouts = TrainingRollouts()
        self.last_update: UpdateStats | None = None  # of this call of learn
        check = partial(check_setting, self)
        check_settings(self)
        if check("_init_setup_model", _init_setup_model):
            check("env", env)
        if check("policy", policy) not in self.policy_aliases and isinstance(policy, str):
            names = ", ".join(f'"{name}"' for name in self.policy_aliases)
            raise not_allowed(f"{type(self).__name__}: policy", policy, f"{names} or a class")
        of_sb3 = inspect.signature(OnPolicyAlgorithm).parameters
        shared = {f.name: getattr(self, f.name) for f in fields(self) if f.name in of_sb3}
        super().__init__(
            policy,
            env,  # None where a file is loaded
            **shared,
            ent_coef=0.0,
            vf_coef=0.0,
            max_grad_norm=0.0,
            rollout_buffer_kwargs=check("rollout_buffer_kwargs", rollout_buffer_kwargs),
            stats_window_size=check("stats_window_size", stats_window_size),
            policy_kwargs=check("policy_kwargs", policy_kwargs),
            device=check("device", device),
            _init_setup_model=False,
            supported_action_spaces=ACTION_SPACES,
        )
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        check_settings(self)
        if self.rollout_buffer_class is None:
            is_dict = isinstance(self.observation_space, spaces.Dict)
            buffer = DictEpisodeRolloutBuffer if is_dict else EpisodeRolloutBuffer
            self.rollout_buffer_class = buffer
        super()._setup_model()
        fuse(self.policy.optimizer)
        self.rollouts.adopt(vars(self))
        self.alpha_schedule = checked_schedule(self, "alpha", POSITIVE)
        self.replay = Replay(self.n_reused_rollouts, self.gamma, self.gae_lambda)
        self.tracker = make_tracker(self)

    def _setup_lr_schedule(self) -> None:
        self.lr_schedule = checked_schedule(self, "learning_rate", LEARNING_RATE)

    @property
    def actor(self) -> ActorParameters:
        """The parameters θ that log π depends on."""
        return self._actors.find(self.policy, self.observation_space, self._last_obs)

    @property
    def uses_critic(self) -> bool:
        """Whether V enters the advantages at all."""
        bootstraps = self.bootstrap_truncated or not self.tracker.whole_episodes
        return self.baseline or bootstraps or self.gae_lambda < 1.0 or self.n_reused_rollouts > 0

    def __getstate__(self) -> dict[str, Any]:
        """Let a copy that is made in mid-rollout be in none: its environments are reset first."""
        return vars(self) | {"_collecting": False}

    def _excluded_save_params(self) -> list[str]:
        derived = ["alpha_schedule", "lr_schedule", "replay", "tracker", "ranks", "_actors"]
        return [*super()._excluded_save_params(), "last_update", "_collecting", *derived]

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        self.replay.clear()  # the environment may be another one
        self.last_update = None
        before = self._last_obs
        prepared = super()._setup_learn(*args, **kwargs)
        if self._last_obs is not before:  # all environments were reset
            self.rollouts.interrupted = False
        return prepared

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Fill the buffer with the tracker's segments; return False if a callback asked to stop."""
        assert isinstance(rollout_buffer, EpisodeRolloutBuffer)  # set by _setup_model
        return self.rollouts.collect(self, env, callback, rollout_buffer, n_rollout_steps)

    def train(self) -> None:
        """Update the policy from the rollout just collected (DESIGN section 5), or not at all."""
        with unchanged_on_error(self.policy):
            self.policy.set_training_mode(False)
            self._update_learning_rate(self.policy.optimizer)
            data = self._data()
            estimate = self._estimate(data)
            solver = self._update_solver(data.fresh)
            target_kl = self._update_target_kl(data.fresh)
            model = local_model(self, estimate, solver, target_kl)
            alpha = self.alpha_schedule(self._current_progress_remaining)
            if target_kl is not None:
                alpha = self.kl_control.first_alpha(alpha)
            evaluator = CandidateEvaluator(
                self.policy, self.actor, estimate.gradient_batch, self.max_batch_timesteps
            )
            step, accepted = take_step(evaluator, model, solver, alpha, target_kl)
            value_loss = self._fit_critic(data)
            if step.evaluation.finite:  # a rollout whose step was not finite is not reused
                self.replay.append(data.fresh)
                if target_kl is not None:
                    self.kl_control.alpha = step.alpha
            share_policy(self.policy)
            self._n_updates += 1
            self.last_update = UpdateStats(
                **step_statistics(estimate, model, step, accepted),
                **rollout_statistics(data, self.rollouts, self.policy),
                n_updates=self._n_updates,
                n_trials=evaluator.n_trials,
                target_kl=target_kl,
                value_loss=value_loss,
            )
        self.last_update.write(self.logger)  # an error of the logger undoes no update

    @torch.enable_grad()
    def estimate_curvature(
        self, n_episodes: int, env: VecEnv | None = None, *, progress_bar: bool = False
    ) -> CurvatureEstimate:
        """Estimate gradient and Hessian of J at the current policy from fresh episodes.

        The estimators are those of the constructor's arguments; nothing is learnt, and the
        episodes do not count as training. With several ranks all must call, and share the episodes.

        Parameters
        ----------
        n_episodes
            Number of episodes, used for the gradient and for the Hessian alike.
        env
            Where to simulate; ``None``: the training environment.
        progress_bar
            Show the episodes simulated, on each rank its own; needs tqdm and rich.
        """
        n_episodes = COUNT("estimate_curvature: n_episodes", n_episodes)
        env = (_VEC_ENV | NONE)("estimate_curvature: env", env)
        show = FLAG("estimate_curvature: progress_bar", progress_bar)
        share_policy(self.policy)
        buffer = self.rollouts.evaluate(self, n_episodes, env, show=show)
        return self._estimate_from(self._batch(buffer))

    def _data(self) -> UpdateData:
        """Return the episodes of this update, each rollout as the present policy sees it."""
        fresh = self._batch(self.rollout_buffer)
        if not self.tracker.whole_episodes:
            fresh = replace(fresh, unit="n_steps")
        return UpdateData(fresh, self.replay.reweighted(self.policy, **self._weighting))

    def _batch(self, buffer: RolloutBuffer) -> EpisodeBatch:
        assert isinstance(buffer, EpisodeRolloutBuffer)  # by _setup_model
        return buffer.episode_batch(**self._weighting)

    @property
    def _weighting(self) -> dict[str, bool]:
        names = ("baseline", "normalize_advantage", "discount_visitation")
        return {name: getattr(self, name) for name in names}

    def _estimate(self, data: UpdateData) -> CurvatureEstimate:
        """Estimate g from m_k and H from b_k of the fresh episodes, and from the earlier ones."""
        return self._estimate_from(*data.draw(*self.rollouts.batch_sizes, self._rng))

    def _estimate_from(
        self,
        batch: EpisodeBatch,
        hessian_batch: EpisodeBatch | None = None,
        fisher_batch: EpisodeBatch | None = None,
    ) -> CurvatureEstimate:
        return estimate_curvature(
            self.policy,
            self.actor,
            batch,
            HESSIAN_ESTIMATORS.resolve(self.hessian_estimator, self),
            hessian_batch=hessian_batch,
            fisher_batch=fisher_batch,
            max_steps=self.max_batch_timesteps,
        )

    def _update_solver(self, batch: EpisodeBatch) -> SubproblemSolver:
        """Return the solver of this update: what CRPN and ACRPN differ in."""
        raise NotImplementedError

    def _update_target_kl(self, batch: EpisodeBatch) -> float | None:
        """Return ``target_kl``, scaled by the spread of the returns unless the user objects."""
        if self.target_kl is None or not self.scale_target_kl:
            return self.target_kl
        unit = RunningMoments(self.get_vec_normalize_env()).reward_unit
        deviation = unit * math.sqrt(batch.moments(batch.returns)[1])
        return self.kl_control.scaled_target(self.target_kl, deviation)

    def _fit_critic(self, data: UpdateData) -> float | None:
        """Regress V on the λ-returns; ``None`` where V is not used, or all of it is frozen.

        Reused rollouts share the minibatches of the fresh one: their number does not grow.
        """
        if not (self.uses_critic and has_own_parameters(self.policy, self.actor)):
            return None
        per_pass = math.ceil(data.fresh.total_steps / self.batch_size)
        return fit_critic(
            self.policy,
            self.actor,
            data.joined,
            n_minibatches=self.n_critic_updates * per_pass,
            batch_size=self.batch_size,
            rng=self._rng,
        )
