"""Rollouts of a tracker's segments, with SB3's callbacks, counters and hooks."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_crpn.algorithm.settings import checked_schedule
from sb3_crpn.arrays import IntArray
from sb3_crpn.checks import not_allowed, real
from sb3_crpn.distributed import local_count, world_size
from sb3_crpn.episodes import (
    TRACKERS,
    Collector,
    EpisodeRolloutBuffer,
    ProgressTracker,
    RolloutSize,
    Tracker,
    Transition,
    steps_to_quota,
)
from sb3_crpn.episodes.running_moments import frozen_moments
from sb3_crpn.episodes.time_limits import EPISODE_LIMIT, has_time_limit, warn_of_endless_episodes
from sb3_crpn.progress import progress

if TYPE_CHECKING:
    from sb3_crpn.algorithm.algorithm import PolicyNewtonAlgorithm

# An environment without a known time limit counts as endless once an episode outlasts the budget
# of ``learn``, but not before so many steps
MIN_EPISODE_LIMIT = 1000


@dataclass
class TrainingRollouts:
    """Collects the rollouts that a model learns from, and knows where its environments stand.

    Attributes
    ----------
    mean_episode_length
        Of the last rollout; ``None`` before the first.
    batch_sizes
        m_k and b_k of the last rollout, ``None`` where they follow from ``n_steps``.
    used_fraction
        The part of the last rollout's timesteps that is learnt from.
    mean_reward
        Of the last rollout's steps, in the environment's own units.
    trajectory_times
        The time of each training environment's next step in its trajectory, [n_envs].
    interrupted
        Whether it is not known where the training environments stand, as in mid-rollout.
    """

    mean_episode_length: float | None = None
    batch_sizes: tuple[int | None, int | None] = (None, None)
    used_fraction: float = 1.0
    mean_reward: float = 0.0
    trajectory_times: IntArray | None = None
    interrupted: bool = False

    def collect(
        self,
        model: PolicyNewtonAlgorithm,
        env: VecEnv,
        callback: BaseCallback,
        buffer: EpisodeRolloutBuffer,
        n_steps: int,
    ) -> bool:
        """Fill the buffer with max(m_k, b_k) episodes, or with ``n_steps`` steps an environment.

        Whole episodes are run at their last mean length. At first no length is known: one episode
        of each environment tells it, and is thrown away if more were to be run.
        """
        self.batch_sizes = _scheduled_sizes(model)
        callback.on_rollout_start()
        lengths_unknown = model.tracker.whole_episodes and self.mean_episode_length is None
        n_episodes = self._n_episodes(n_steps, env.num_envs)
        size = RolloutSize(n_steps, n_episodes, model.horizon)
        completed = self._collect_shares(model, env, callback, buffer, size)
        if completed and lengths_unknown:
            n_wanted = self._n_episodes(n_steps, env.num_envs)
            if n_wanted > n_episodes:
                size = replace(size, n_episodes=n_wanted)
                completed = self._collect_shares(model, env, callback, buffer, size)
        if completed:
            callback.on_rollout_end()
        return completed

    def _n_episodes(self, n_steps: int, n_envs: int) -> int:
        """Return how many episodes all ranks simulate, as far as episode lengths are known."""
        given = [number for number in self.batch_sizes if number is not None]
        if self.batch_sizes[0] is None:
            quota = steps_to_quota(n_steps, self.mean_episode_length)
            given.append(quota * n_envs * world_size())
        return max(given)

    def _collect_shares(
        self,
        model: PolicyNewtonAlgorithm,
        env: VecEnv,
        callback: BaseCallback,
        buffer: EpisodeRolloutBuffer,
        size: RolloutSize,
    ) -> bool:
        """Simulate this rank's share of the rollout; only afterwards ranks add up timesteps."""
        before = model.num_timesteps
        completed = self._simulate(model, env, callback, buffer, _share(size))
        lengths = buffer.lengths
        simulated = model.num_timesteps - before
        stopped, n_simulated, n_segments, n_steps, rewards = model.ranks.totals(
            not completed, simulated, len(lengths), lengths.sum(), self.mean_reward * simulated
        )
        model.num_timesteps = before + int(n_simulated)
        if stopped:
            return False
        self.mean_episode_length = n_steps / n_segments
        self.used_fraction = n_steps / n_simulated
        self.mean_reward = rewards / n_simulated
        return True

    def _simulate(
        self,
        model: PolicyNewtonAlgorithm,
        env: VecEnv,
        callback: BaseCallback,
        buffer: EpisodeRolloutBuffer,
        size: RolloutSize,
    ) -> bool:
        """Run the environments, counting timesteps and calling back as SB3 does."""
        collector = self._collector(model, env)
        collector.timestep = model.num_timesteps
        if size.horizon is None and not has_time_limit(env):
            budget = math.ceil((model._total_timesteps - model.num_timesteps) / env.num_envs)
            collector.expect_an_end_within(max(budget, 2 * size.n_steps, MIN_EPISODE_LIMIT))
        names = {
            "self": model,
            "env": env,
            "callback": callback,
            "rollout_buffer": buffer,
            "n_rollout_steps": size.n_steps,
        }

        def on_step(transition: Transition) -> bool:
            model.num_timesteps += env.num_envs
            callback.update_locals(names | vars(transition))
            if not callback.on_step():
                return False
            model._update_info_buffer(transition.infos, transition.dones)
            return True

        with self._occupying(model, env):
            try:
                completed = collector.collect(buffer, model.tracker, size, on_step)
            finally:
                model.num_timesteps = collector.timestep
                if env is model.env:  # a callback may have set another
                    self._leave(model, collector)
        self.mean_reward = collector.mean_reward
        return completed

    def evaluate(
        self,
        model: PolicyNewtonAlgorithm,
        n_episodes: int,
        env: VecEnv | None,
        *,
        show: bool = False,
    ) -> EpisodeRolloutBuffer:
        """Simulate whole episodes outside training: no callbacks, no timesteps counted.

        ``env=None`` is the training environment, which the next rollout finds as if a rollout of
        its own had come before. ``show``: with a progress bar.
        """
        target = model.env if env is None else env
        if target is None:
            raise ValueError("env=None is not allowed for a model without an environment")
        buffer = copy(model.rollout_buffer)
        assert isinstance(buffer, EpisodeRolloutBuffer)  # by the checks of arguments
        buffer.n_envs = target.num_envs
        size = _share(RolloutSize(model.n_steps, n_episodes, model.horizon))
        bar = progress("episodes", size.n_episodes, show=show)
        with bar as tick, self._occupying(model, target), frozen_moments(target):
            collector = self._collector(model, target)
            if size.horizon is None and not has_time_limit(target):
                collector.expect_an_end_within(EPISODE_LIMIT)
            try:
                collector.collect(buffer, ProgressTracker(tick), size)
            finally:
                if target is model.env:
                    self._leave(model, collector)
        return buffer

    @contextmanager
    def _occupying(self, model: PolicyNewtonAlgorithm, env: VecEnv) -> Iterator[None]:
        """Mark the time of a rollout: the training environment serves one at a time."""
        if model._collecting and env is model.env:
            raise RuntimeError(
                "the training environment is in the middle of a rollout: "
                "pass an environment of its own with env="
            )
        outer, model._collecting = model._collecting, True
        distribution = model.policy.action_dist  # with gSDE it holds the rollout's noise
        noise = dict(vars(distribution))
        try:
            yield
        finally:
            model._collecting = outer
            if outer:
                vars(distribution).update(noise)

    def _collector(self, model: PolicyNewtonAlgorithm, env: VecEnv) -> Collector:
        """Return a collector that goes on where the training environments stand.

        Until :meth:`_leave`, a file or a copy of the model does not know where that is.
        """
        model.policy.set_training_mode(False)
        collector = Collector(
            model.policy,
            env,
            bootstrap_truncated=model.bootstrap_truncated,
            uses_critic=model.uses_critic,
            sde_sample_freq=model.sde_sample_freq,
        )
        if env is not model.env or model._last_obs is None:
            collector.reset()
            return collector
        times = self._times(model)
        was_interrupted, self.interrupted = self.interrupted, True
        if was_interrupted and collector.can_reset:
            collector.reset()
        else:
            collector.stand(model._last_obs, times)
        return collector

    def _times(self, model: PolicyNewtonAlgorithm) -> IntArray:
        """Return the time of each training environment's next step in its trajectory, [n_envs].

        Where it is not known, none stands at the start of an episode.
        """
        starts = np.asarray(model._last_episode_starts).astype(np.bool_)
        times = self.trajectory_times
        if times is None or len(times) != len(starts):
            times = np.ones(len(starts), dtype=np.int64)
        return np.maximum(times, 1) if self.interrupted else np.where(starts, 0, times)

    def _leave(self, model: PolicyNewtonAlgorithm, collector: Collector) -> None:
        """Remember where the training environments stand."""
        model._last_obs = collector.observations
        model._last_episode_starts = collector.at_episode_start
        self.trajectory_times = collector.times
        self.interrupted = not collector.located

    def adopt(self, attributes: dict[str, Any]) -> None:
        """Take over what older files hold as attributes of the model, which they lose."""
        for field in fields(self):
            if (name := f"_{field.name}") in attributes:
                setattr(self, field.name, attributes.pop(name))


def make_tracker(model: PolicyNewtonAlgorithm) -> Tracker:
    """Return the tracker that ``rollout`` names; check the arguments that depend on its kind."""
    kind = TRACKERS[model.rollout] if isinstance(model.rollout, str) else model.rollout
    tracker, name = kind(), type(model).__name__
    if not hasattr(tracker, "whole_episodes"):
        raise not_allowed(f"{name}: rollout", kind, '"episodes", "timesteps" or a class of Tracker')
    if tracker.whole_episodes:
        if model.env is not None and model.horizon is None:
            warn_of_endless_episodes(model.env)
        return tracker
    for argument in ("n_episodes", "n_hessian_episodes"):
        if (value := getattr(model, argument)) is not None:
            raise not_allowed(f"{name}: {argument}", value, "None where rollouts are of timesteps")
    if model.normalize_advantage and model.n_steps * model.n_envs * world_size() == 1:
        allowed = "above 1 in all environments together, with normalize_advantage=True"
        raise not_allowed(f"{name}: n_steps", model.n_steps, allowed)
    return tracker


def _share(size: RolloutSize) -> RolloutSize:
    """Return this rank's share of a rollout; timesteps are each rank's own."""
    return replace(size, n_episodes=local_count(size.n_episodes))


def _scheduled_sizes(model: PolicyNewtonAlgorithm) -> tuple[int | None, int | None]:
    """Return m_k and b_k at the present progress, ``None`` where they follow from ``n_steps``."""

    def number(name: str) -> int | None:
        if getattr(model, name) is None:
            return None
        return round(checked_schedule(model, name, real(1.0))(model._current_progress_remaining))

    return number("n_episodes"), number("n_hessian_episodes")
