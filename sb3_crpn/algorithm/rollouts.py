"""Rollouts of a tracker's segments, with SB3's callbacks, counters and hooks."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_crpn.algorithm.distributed_training import DistributedTraining
from sb3_crpn.algorithm.settings import PolicyNewtonSettings
from sb3_crpn.arrays import IntArray
from sb3_crpn.distributed import local_count, world_size
from sb3_crpn.episodes import (
    Collector,
    EpisodeRolloutBuffer,
    RolloutSize,
    TickingTracker,
    Tracker,
    Transition,
    steps_to_quota,
)
from sb3_crpn.progress import progress

# An environment without a known time limit counts as endless once an episode outlasts the budget
# of ``learn``, but not before so many steps
MIN_EPISODE_LIMIT = 1000


class RolloutAlgorithm(OnPolicyAlgorithm, PolicyNewtonSettings):
    """An on-policy algorithm that learns from the segments of a tracker (DESIGN section 2)."""

    tracker: Tracker
    ranks: DistributedTraining
    _mean_episode_length: float | None = None  # of the last rollout
    _collecting = False
    _interrupted = False  # where the environments stand is unknown
    _batch_sizes: tuple[int | None, int | None] = (None, None)
    _used_fraction = 1.0
    _mean_reward = 0.0  # of the last rollout, in the environment's own units
    _trajectory_times: IntArray | None = None  # where the training environments stand

    def __getstate__(self) -> dict[str, Any]:
        """Let a copy that is made in mid-rollout be in none: its environments are reset first."""
        in_rollout = {"_collecting": False, "_interrupted": True} if self._collecting else {}
        return vars(self) | in_rollout

    def _scheduled_episodes(self) -> tuple[int | None, int | None]:
        """Return m_k and b_k of this update, ``None`` where they follow from ``n_steps``."""
        raise NotImplementedError

    @property
    def uses_critic(self) -> bool:
        """Whether V enters the advantages at all."""
        return (
            self.baseline
            or self.bootstrap_truncated
            or self.gae_lambda < 1.0
            or self.n_reused_rollouts > 0
            or not self.tracker.whole_episodes
        )

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Fill the buffer with what the tracker keeps of the current policy's trajectories.

        With whole episodes max(m_k, b_k) are simulated; where neither is given, ``n_rollout_steps``
        steps per environment, in whole episodes at their last mean length. At first no length is
        known: one episode of each environment tells it, and is thrown away if more were to be run.

        Returns
        -------
        bool
            False if a callback asked to stop.

        Raises
        ------
        ValueError
            A reward or an observation is not finite, or no episode comes to an end.
        """
        assert isinstance(rollout_buffer, EpisodeRolloutBuffer)  # set by _setup_model
        self._batch_sizes = self._scheduled_episodes()
        callback.on_rollout_start()
        lengths_unknown = self.tracker.whole_episodes and self._mean_episode_length is None
        n_episodes = self._n_episodes(n_rollout_steps, env.num_envs)
        completed = self._collect_shares(env, callback, rollout_buffer, n_episodes)
        if completed and lengths_unknown:
            n_wanted = self._n_episodes(n_rollout_steps, env.num_envs)
            if n_wanted > n_episodes:
                completed = self._collect_shares(env, callback, rollout_buffer, n_wanted)
        if completed:
            callback.on_rollout_end()
        return completed

    def _n_episodes(self, n_steps: int, n_envs: int) -> int:
        """Return how many episodes all ranks simulate, as far as episode lengths are known."""
        given = [number for number in self._batch_sizes if number is not None]
        if self._batch_sizes[0] is None:
            quota = steps_to_quota(n_steps, self._mean_episode_length)
            given.append(quota * n_envs * world_size())
        return max(given)

    def _collect_shares(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: EpisodeRolloutBuffer,
        n_episodes: int,
    ) -> bool:
        """Simulate this rank's share of the rollout; only afterwards ranks add up timesteps."""
        before = self.num_timesteps
        size = RolloutSize(self.n_steps, local_count(n_episodes), self.horizon)
        completed = self._collect_training_rollout(env, callback, rollout_buffer, size)
        lengths = rollout_buffer.lengths
        simulated = self.num_timesteps - before
        stopped, n_simulated, n_segments, n_steps, rewards = self.ranks.totals(
            not completed, simulated, len(lengths), lengths.sum(), self._mean_reward * simulated
        )
        self.num_timesteps = before + int(n_simulated)
        if stopped:
            return False
        self._mean_episode_length = n_steps / n_segments
        self._used_fraction = n_steps / n_simulated
        self._mean_reward = rewards / n_simulated
        return True

    def _collect_training_rollout(
        self,
        env: VecEnv,
        callback: BaseCallback,
        buffer: EpisodeRolloutBuffer,
        size: RolloutSize,
    ) -> bool:
        """Run the environments, counting timesteps and calling back as SB3 does."""
        collector = self._collector(env)
        collector.timestep = self.num_timesteps
        if size.horizon is None and _time_limit(env) is None:
            budget = math.ceil((self._total_timesteps - self.num_timesteps) / env.num_envs)
            collector.expect_an_end_within(max(budget, 2 * size.n_steps, MIN_EPISODE_LIMIT))
        names = {
            "self": self,
            "env": env,
            "callback": callback,
            "rollout_buffer": buffer,
            "n_rollout_steps": size.n_steps,
        }

        def on_step(transition: Transition) -> bool:
            self.num_timesteps += env.num_envs
            callback.update_locals(names | vars(transition))
            if not callback.on_step():
                return False
            self._update_info_buffer(transition.infos, transition.dones)
            return True

        with _Rollout(self, env):
            try:
                completed = collector.collect(buffer, self.tracker, size, on_step)
            finally:
                self.num_timesteps = collector.timestep
                if env is self.env:  # a callback may have set another
                    self._leave(collector)
            self._interrupted = not completed
            self._mean_reward = collector.mean_reward
        return completed

    def _collector(self, env: VecEnv) -> Collector:
        """Return a collector that goes on where the training environments stand."""
        self.policy.set_training_mode(False)
        collector = Collector(
            self.policy,
            env,
            bootstrap_truncated=self.bootstrap_truncated,
            uses_critic=self.uses_critic,
            sde_sample_freq=self.sde_sample_freq,
        )
        if env is self.env and self._last_obs is not None:
            collector.stand(self._last_obs, self._times(env.num_envs))
            if self._interrupted and collector.can_reset:
                collector.reset()
        else:
            collector.reset()
        return collector

    def _times(self, n_envs: int) -> IntArray:
        """Return the time of each training environment's next step in its trajectory, [n_envs].

        Where it is not known, none stands at the start of an episode.
        """
        times = self._trajectory_times
        if times is None or len(times) != n_envs:
            times = np.ones(n_envs, dtype=np.int64)
        starts = np.asarray(self._last_episode_starts).astype(np.bool_)
        return np.maximum(times, 1) if self._interrupted else np.where(starts, 0, times)

    def _leave(self, collector: Collector) -> None:
        """Remember where the training environments stand."""
        self._last_obs = collector.observations
        self._last_episode_starts = collector.at_episode_start
        self._trajectory_times = collector.times

    def _collect_evaluation_episodes(
        self, n_episodes: int, env: VecEnv | None, show: bool
    ) -> EpisodeRolloutBuffer:
        """Simulate whole episodes outside training: no callbacks, no timesteps counted.

        ``env=None`` is the training environment, which the next rollout finds as if a rollout of
        its own had come before.
        """
        target = self.env if env is None else env
        if target is None:
            raise ValueError("env=None is not allowed for a model without an environment")
        buffer = self._new_buffer(target.num_envs)
        normalizer = unwrap_vec_normalize(target)
        learns = normalizer is not None and normalizer.training
        size = RolloutSize(self.n_steps, local_count(n_episodes), self.horizon)
        with progress("episodes", size.n_episodes, show=show) as tick, _Rollout(self, target):
            try:
                if normalizer is not None:
                    normalizer.training = False
                collector = self._collector(target)
                collector.collect(buffer, TickingTracker(tick), size)
            finally:
                if normalizer is not None:
                    normalizer.training = learns
            if target is self.env:
                self._leave(collector)
                self._interrupted = False
        return buffer

    def _new_buffer(self, n_envs: int) -> EpisodeRolloutBuffer:
        assert self.rollout_buffer_class is not None  # by _setup_model
        buffer = self.rollout_buffer_class(
            self.n_steps,
            self.observation_space,
            self.action_space,
            device=self.device,
            gamma=self.gamma,
            gae_lambda=self.gae_lambda,
            n_envs=n_envs,
            **self.rollout_buffer_kwargs,
        )
        assert isinstance(buffer, EpisodeRolloutBuffer)  # by the checks of arguments
        return buffer


class _Rollout:
    """Marks the time of a rollout: the training environment serves one at a time."""

    def __init__(self, model: RolloutAlgorithm, env: VecEnv) -> None:
        if model._collecting and env is model.env:
            raise RuntimeError(
                "the training environment is in the middle of a rollout: "
                "pass an environment of its own with env="
            )
        self._model, self._outer, self._is_training_env = model, model._collecting, env is model.env

    def __enter__(self) -> None:
        self._model._collecting = True

    def __exit__(self, kind: type[BaseException] | None, *rest: Any) -> None:
        self._model._collecting = self._outer
        if kind is not None and self._is_training_env:
            self._model._interrupted = True


def _time_limit(env: VecEnv) -> int | None:
    """Return the largest time limit of the environments' specs, ``None`` where one has none."""
    try:
        limits = [getattr(spec, "max_episode_steps", None) for spec in env.get_attr("spec")]
    except (AttributeError, NotImplementedError):
        return None
    known = [limit for limit in limits if limit is not None]
    return max(known) if len(known) == len(limits) else None


def warn_of_endless_episodes(env: VecEnv) -> None:
    """Warn where an environment is registered without a time limit and may thus never end."""
    try:
        specs = env.get_attr("spec")
    except (AttributeError, NotImplementedError):
        return
    for spec in specs:
        if spec is not None and spec.max_episode_steps is None:
            warnings.warn(
                f"{spec.id} has no time limit, and whole episodes are learnt from: if its episodes "
                'do not end by themselves, pass horizon=H or rollout="timesteps"',
                stacklevel=4,
            )
            return
