"""Rollouts of whole episodes, with SB3's callbacks, counters and hooks."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import obs_as_tensor
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_crpn.algorithm.ranks import DistributedTraining
from sb3_crpn.algorithm.settings import PolicyNewtonSettings
from sb3_crpn.arrays import Array, IntArray
from sb3_crpn.distributed import all_sum, local_count, world_size
from sb3_crpn.episodes import EpisodeRolloutBuffer, EpisodeTracker, episodes_per_env, steps_to_quota
from sb3_crpn.episodes.tracker import EpisodeEnd

# An environment is taken to be endless when no episode ends within so many steps: nearly twice
# the longest episode in common use (Atari's 108,000 frames at a frame skip of 4).
ENDLESS = 50_000

# What a rollout outside training must leave as it was
_COUNTERS = ("num_timesteps", "ep_info_buffer", "ep_success_buffer")


class EpisodeCollection(DistributedTraining, OnPolicyAlgorithm, PolicyNewtonSettings):
    """Collects whole episodes, a fixed quota from each environment (DESIGN section 2)."""

    _mean_episode_length: float | None = None  # of the last rollout
    _collecting: bool = False
    _batch_sizes: tuple[int | None, int | None] = (None, None)

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
        )

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Fill the buffer with whole episodes of the current policy.

        max(m_k, b_k) episodes are simulated; where neither is given, ``n_rollout_steps`` steps
        per environment, in whole episodes at their last mean length. Nobody knows it at first:
        one episode of each environment tells, and is thrown away if more should have been run.

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
        lengths_unknown = self._mean_episode_length is None
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
        """Simulate this rank's share of the episodes; only afterwards ranks add up timesteps."""
        quotas = episodes_per_env(local_count(n_episodes), env.num_envs)
        before = self.num_timesteps
        completed = self._collect_episodes(env, callback, rollout_buffer, quotas)
        lengths = rollout_buffer.lengths
        own = [not completed, self.num_timesteps - before, len(lengths), lengths.sum()]
        stopped, n_simulated, n_kept, n_steps = all_sum(
            torch.tensor(own, dtype=torch.float64)
        ).tolist()
        self.num_timesteps = before + int(n_simulated)
        self._share_statistics()
        if stopped:
            return False
        self._mean_episode_length = n_steps / n_kept
        return True

    def _collect_episodes(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: EpisodeRolloutBuffer,
        quotas: IntArray,
    ) -> bool:
        """Run the environments until every quota is met; see :meth:`collect_rollouts`."""
        outer = self._collecting
        if outer and env is self.env:
            raise RuntimeError(
                "the training environment is in the middle of a rollout: "
                "pass an environment of its own with env="
            )
        completed = False
        self._collecting = True
        try:
            completed = self._run_environments(env, callback, rollout_buffer, quotas)
        finally:
            self._collecting = outer
            if not completed:
                # where the environments stand is unknown: the next rollout resets them
                self._last_episode_starts = np.zeros(env.num_envs, dtype=bool)
        if completed:
            if self.uses_critic:
                rollout_buffer.evaluate(self.policy)
            rollout_buffer.compute_advantages()
        return completed

    def _run_environments(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: EpisodeRolloutBuffer,
        quotas: IntArray,
    ) -> bool:
        self.policy.set_training_mode(False)
        can_reset = _early_resets_allowed(env)
        if can_reset and not np.all(self._last_episode_starts):
            self._reset_environments(env)
        _require_finite("observation", self._last_obs, self.num_timesteps)
        tracker = EpisodeTracker(quotas, np.array(self._last_episode_starts, bool), self.horizon)
        rollout_buffer.reset()
        n_steps = last_end = 0
        unknown = torch.zeros(env.num_envs)  # V and log π: evaluated at the end, all at once
        while not tracker.complete:
            if self.use_sde and (
                n_steps == 0 or (self.sde_sample_freq > 0 and n_steps % self.sde_sample_freq == 0)
            ):
                self.policy.reset_noise(env.num_envs)
            actions, clipped_actions = self._act(self._last_obs)
            new_obs, rewards, dones, infos = env.step(clipped_actions)
            self.num_timesteps += env.num_envs
            _require_finite("reward", rewards, self.num_timesteps)
            _require_finite("observation", new_obs, self.num_timesteps)
            callback.update_locals(locals())
            if not callback.on_step():
                return False
            self._update_info_buffer(infos, dones)
            n_steps += 1
            rollout_buffer.add(
                self._last_obs, actions, rewards, self._last_episode_starts, unknown, unknown
            )
            for end in tracker.advance(dones):
                last_end = n_steps
                rollout_buffer.close_episode(end, self._terminal_value(end, new_obs, infos))
            self._last_obs, self._last_episode_starts = new_obs, dones  # type: ignore[assignment]
            if tracker.needs_reset and can_reset:
                self._reset_environments(env)
                tracker.restart()
                _require_finite("observation", self._last_obs, self.num_timesteps)
            _require_progress(n_steps - last_end)
        callback.update_locals(locals())
        return True

    def _collect_fresh(self, n_episodes: int, env: VecEnv | None) -> EpisodeRolloutBuffer:
        """Simulate episodes outside training: no callbacks, no timesteps counted.

        ``env=None`` is the training environment, which the next rollout finds as if a rollout of
        its own had come before.
        """
        env = None if env is self.env else env
        target = self.env if env is None else env
        if target is None:
            raise ValueError("env=None is not allowed for a model without an environment")
        buffer = self._new_buffer(target.num_envs)
        state = {name: getattr(self, name) for name in _COUNTERS}
        normalizer = unwrap_vec_normalize(target)
        normalizes = normalizer is not None and normalizer.training
        place = (self._last_obs, self._last_episode_starts)
        self.ep_info_buffer, self.ep_success_buffer = deque(maxlen=1), deque(maxlen=1)
        try:
            if normalizer is not None:
                normalizer.training = False
            if env is not None or self._last_obs is None:
                self._reset_environments(target)
            callback = CallbackList([])
            callback.init_callback(self)
            quotas = episodes_per_env(local_count(n_episodes), target.num_envs)
            self._collect_episodes(target, callback, buffer, quotas)
        finally:
            self.__dict__.update(state)
            if normalizer is not None:
                normalizer.training = normalizes
            if env is not None:
                self._last_obs, self._last_episode_starts = place
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
        assert isinstance(buffer, EpisodeRolloutBuffer)  # by check_arguments
        return buffer

    def _act(self, obs: Any) -> tuple[Array, Array]:
        """Sample actions; return them raw and as the environment takes them."""
        with torch.no_grad():
            distribution = self.policy.get_distribution(obs_as_tensor(obs, self.device))
            sampled = distribution.get_actions()
        actions = sampled.cpu().numpy().reshape(-1, *(self.action_space.shape or ()))
        if not isinstance(self.action_space, spaces.Box):
            return actions, actions
        if self.policy.squash_output:
            return actions, self.policy.unscale_action(actions)
        return actions, np.clip(actions, self.action_space.low, self.action_space.high)

    def _terminal_value(self, end: EpisodeEnd, new_obs: Any, infos: list[dict[str, Any]]) -> float:
        """Return V of the state after a truncated episode, 0 after a terminated one."""
        info = infos[end.env]
        truncated = end.cut or info.get("TimeLimit.truncated", False)
        if not (self.bootstrap_truncated and truncated):
            return 0.0
        if not end.cut:
            last_obs = info["terminal_observation"]
        elif isinstance(new_obs, dict):
            last_obs = {key: array[end.env] for key, array in new_obs.items()}
        else:
            last_obs = new_obs[end.env]
        _require_finite("terminal observation", last_obs, self.num_timesteps)
        with torch.no_grad():
            return float(self.policy.predict_values(self.policy.obs_to_tensor(last_obs)[0]))

    def _reset_environments(self, env: VecEnv) -> None:
        self._last_obs = env.reset()  # type: ignore[assignment]
        self._last_episode_starts = np.ones(env.num_envs, dtype=bool)


def _early_resets_allowed(env: VecEnv) -> bool:
    """Whether every environment may be reset in mid-episode: SB3's ``Monitor`` can forbid it."""
    for index, monitored in enumerate(env.env_is_wrapped(Monitor)):
        if monitored:
            try:
                if not env.get_attr("allow_early_resets", index)[0]:
                    return False
            except AttributeError:  # a vectorised environment that keeps the statistics itself
                continue
    return True


def _require_finite(what: str, value: Any, timestep: int) -> None:
    """Raise when the environment returned NaN or infinity."""
    arrays = value.values() if isinstance(value, dict) else (value,)
    for array in arrays:
        if np.issubdtype(array.dtype, np.floating) and not np.isfinite(array).all():
            raise ValueError(
                f"the environment returned a non-finite {what} at timestep {timestep}: {array}; "
                "the policy is unchanged. SB3's VecCheckNan finds the source"
            )


def _require_progress(steps_without_end: int) -> None:
    """Raise when no episode comes to an end."""
    if steps_without_end >= ENDLESS:
        raise ValueError(
            f"no episode ended within {ENDLESS} steps, but this algorithm learns from whole "
            "episodes: pass horizon=H to cut them after H steps, or wrap the environment in "
            "gymnasium.wrappers.TimeLimit"
        )
