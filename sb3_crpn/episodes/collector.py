"""Simulating a policy: one collector for training, for estimates and for certificates."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_crpn.arrays import Array, BoolArray, FloatArray, IntArray, Observations
from sb3_crpn.episodes.buffer import EpisodeRolloutBuffer
from sb3_crpn.episodes.observations import all_finite, as_arrays, as_observation
from sb3_crpn.episodes.running_moments import RunningMoments
from sb3_crpn.episodes.tracker import RolloutSize, Segment, Tracker
from sb3_crpn.policy import draw_noise, environment_actions, sample_actions, to_tensor

# An environment is taken to be endless when no episode ends within so many steps: nearly twice
# the longest episode in common use (Atari's 108,000 frames at a frame skip of 4).
ENDLESS = 50_000


@dataclass(frozen=True)
class Transition:
    """One step of every environment, under the names of SB3's ``collect_rollouts``."""

    n_steps: int
    obs_tensor: Observations
    actions: Array
    clipped_actions: Array
    new_obs: Any
    rewards: FloatArray
    dones: BoolArray
    infos: list[dict[str, Any]]


class Collector:
    """Steps a vectorised environment with a policy until a tracker has what it wants.

    Everything that enters from the environment is cast and checked here, once: dones to bool,
    rewards and observations to arrays, terminal observations to those of the space.

    Parameters
    ----------
    policy
        In evaluation mode; actions are drawn from PyTorch's generator.
    env
        The environments.
    bootstrap_truncated
        Whether an episode that a time limit ended is bootstrapped with V of its last observation.
    uses_critic
        Whether V is used at all.
    sde_sample_freq
        Steps after which gSDE's noise is drawn anew; -1: at the start of the rollout alone.

    Attributes
    ----------
    observations, times
        Where the environments stand, [n_envs, …], and the time of each one's next step in its
        trajectory, [n_envs]: 0 after a reset.
    located
        Whether these are known: not before the first reset, nor after an error in an environment.
    mean_reward
        The mean over the steps of the last rollout, in the environment's own units.
    timestep
        Steps of all environments so far, for messages.
    """

    def __init__(
        self,
        policy: ActorCriticPolicy,
        env: VecEnv,
        *,
        bootstrap_truncated: bool,
        uses_critic: bool,
        sde_sample_freq: int = -1,
    ) -> None:
        self.policy, self.env = policy, env
        self.observations: Any = None
        self.times: IntArray = np.zeros(env.num_envs, dtype=np.int64)
        self.located = False
        self.timestep = 0
        self.mean_reward = 0.0
        self._endless_after = self._warn_after = ENDLESS
        self._bootstrap_truncated = bootstrap_truncated
        self._uses_critic = uses_critic
        self._sde_sample_freq = sde_sample_freq
        self.can_reset = _early_resets_allowed(env)
        self._moments = RunningMoments(unwrap_vec_normalize(env))
        self._start_time = time.time()

    @property
    def at_episode_start(self) -> BoolArray:
        """Whether each environment stands at the start of a trajectory, [n_envs]."""
        starts: BoolArray = self.times == 0
        return starts

    def stand(self, observations: Any, times: IntArray) -> None:
        """Say where the environments stand."""
        self.observations, self.times = as_arrays(observations), times
        self._require_finite("observation", self.observations)
        self.located = True

    def reset(self) -> None:
        """Reset all environments."""
        before = self._moments.snapshot()
        self.located = False
        self.observations = as_arrays(self.env.reset())
        self.times = np.zeros(self.env.num_envs, dtype=np.int64)
        self._require_finite("observation", self.observations, before)
        self.located = True

    def expect_an_end_within(self, n_steps: int) -> None:
        """Take the environments for endless after ``n_steps`` steps; warn after a fifth of them.

        For environments without a time limit that is known, and whole episodes.
        """
        self._endless_after, self._warn_after = min(ENDLESS, n_steps), max(1, n_steps // 5)

    def collect(
        self,
        buffer: EpisodeRolloutBuffer,
        tracker: Tracker,
        size: RolloutSize,
        on_step: Callable[[Transition], bool] = lambda transition: True,
    ) -> bool:
        """Fill the buffer until the tracker is complete.

        Returns
        -------
        bool
            False if ``on_step`` did: the rollout is then not complete.

        Raises
        ------
        ValueError
            A reward or an observation is not finite, or no episode comes to an end.
        """
        if tracker.whole_episodes and self.can_reset and not self.at_episode_start.all():
            self.reset()
        tracker.begin(size, self.times)
        buffer.reset()
        self._n_steps = self._last_end = 0
        self._returns, self._reward_sum = np.zeros(self.env.num_envs), 0.0
        unknown = torch.zeros(self.env.num_envs)  # V and log π: evaluated at the end, all at once
        while not tracker.complete:
            self._draw_noise()
            observations, starts = self.observations, self.at_episode_start
            transition = self._step()
            recording = tracker.recording
            segments = list(tracker.advance(transition.dones))
            unscaled = self._moments.raw_rewards(transition.rewards)
            self._reward_sum += float(unscaled.sum())
            if size.horizon is not None and tracker.whole_episodes:
                self._report_cut_episodes(segments, recording, transition, unscaled)
            if not on_step(transition):
                return False
            actions, rewards = transition.actions, transition.rewards
            buffer.add(observations, actions, rewards, starts, unknown, unknown)
            for segment in segments:
                buffer.close(segment, self._next_observation(segment, tracker, transition))
            if tracker.needs_reset and self.can_reset:
                self.reset()
                tracker.restart()
            if tracker.whole_episodes:
                self._require_progress(segments)
        self.mean_reward = self._reward_sum / (self._n_steps * self.env.num_envs)
        buffer.finish(self.policy if self._uses_critic else None, self.observations)
        return True

    def _draw_noise(self) -> None:
        """Draw gSDE's exploration matrices, at the steps at which SB3 does."""
        if not self.policy.use_sde:
            return
        frequency = self._sde_sample_freq
        if self._n_steps == 0 or (frequency > 0 and self._n_steps % frequency == 0):
            draw_noise(self.policy, self.env.num_envs)

    def _step(self) -> Transition:
        """Take one step in every environment; what ``VecNormalize`` learns of NaN is undone."""
        obs_tensor = to_tensor(self.policy, self.observations)
        actions = sample_actions(self.policy, obs_tensor)
        clipped_actions = environment_actions(self.policy, actions)
        before = self._moments.snapshot()
        self.located = False
        new_obs, rewards, dones, infos = self.env.step(clipped_actions)
        self._n_steps += 1
        self.timestep += self.env.num_envs
        new_obs, rewards = as_arrays(new_obs), np.asarray(rewards)
        self._require_finite("reward", rewards, before)
        self._require_finite("observation", new_obs, before)
        dones = np.asarray(dones).astype(np.bool_)
        # at once: whatever interrupts the rollout from here on, this is where they stand
        self.observations, self.times = new_obs, np.where(dones, 0, self.times + 1)
        self.located = True
        return Transition(
            self._n_steps, obs_tensor, actions, clipped_actions, new_obs, rewards, dones, infos
        )

    def _next_observation(self, segment: Segment, tracker: Tracker, transition: Transition) -> Any:
        """Return the state after a segment that is to be bootstrapped with its value, or ``None``.

        Where an adapter gives no ``terminal_observation``, nothing is bootstrapped, as in SB3.
        """
        if segment.cut:
            if tracker.whole_episodes and not self._bootstrap_truncated:
                return None
            new_obs = transition.new_obs
            if isinstance(new_obs, dict):
                return {key: array[segment.env] for key, array in new_obs.items()}
            return new_obs[segment.env]
        info = transition.infos[segment.env]
        last_obs = info.get("terminal_observation")
        truncated = self._bootstrap_truncated and info.get("TimeLimit.truncated", False)
        if not truncated or last_obs is None:
            return None
        last_obs = as_observation(self.env.observation_space, last_obs)
        self._require_finite("terminal observation", last_obs)
        return last_obs

    def _report_cut_episodes(
        self,
        segments: list[Segment],
        recording: BoolArray,
        transition: Transition,
        unscaled: FloatArray,
    ) -> None:
        """Report an episode that the horizon cut as ``Monitor`` would, and only those recorded."""
        self._returns += unscaled
        for env in np.flatnonzero(~recording & transition.dones):
            transition.infos[env].pop("episode", None)
        for segment in segments:
            if segment.cut:
                transition.infos[segment.env]["episode"] = {
                    "r": float(self._returns[segment.env]),
                    "l": segment.length,
                    "t": round(time.time() - self._start_time, 6),
                }
            self._returns[segment.env] = 0.0
        self._returns[~recording] = 0.0

    def _require_finite(self, what: str, value: Any, moments: Any = None) -> None:
        """Raise when the environment returned NaN or infinity; ``VecNormalize`` forgets it."""
        if all_finite(value):
            return
        if moments is not None:
            self._moments.restore(moments)
        raise ValueError(
            f"the environment returned a non-finite {what} at timestep {self.timestep}: {value}; "
            "the policy is unchanged. SB3's VecCheckNan finds the source"
        )

    def _require_progress(self, segments: list[Segment]) -> None:
        """Warn, and later raise, when no episode comes to an end."""
        if segments:
            self._last_end = self._n_steps
        without_end = self._n_steps - self._last_end
        if without_end == self._warn_after < self._endless_after:
            warnings.warn(
                f"no episode has ended within {without_end} steps, and the environment has no time "
                f"limit that is known: an error follows after {self._endless_after} steps without "
                "an end",
                stacklevel=2,
            )
        if without_end >= self._endless_after:
            raise ValueError(
                f"no episode ended within {without_end} steps, but whole episodes are asked for: "
                "give CRPN or ACRPN horizon=H to cut them after H steps, or wrap the environment "
                "in gymnasium.wrappers.TimeLimit; training alone can do with "
                'rollout="timesteps"'
            )


def _early_resets_allowed(env: VecEnv) -> bool:
    """Whether every environment may be reset in mid-episode: SB3's ``Monitor`` can forbid it.

    Adapters around other libraries' vectorised environments need not answer: they have no
    ``Monitor``.
    """
    try:
        wrapped = env.env_is_wrapped(Monitor)
    except (AttributeError, NotImplementedError):
        return True
    for index, monitored in enumerate(wrapped):
        if monitored:
            try:
                if not env.get_attr("allow_early_resets", index)[0]:
                    return False
            except AttributeError:  # a vectorised environment that keeps the statistics itself
                continue
    return True
