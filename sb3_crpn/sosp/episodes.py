"""Whole episodes of any SB3 actor-critic policy, without a change of the policy's state."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecEnv

from sb3_crpn.episodes import (
    Collector,
    DictEpisodeRolloutBuffer,
    EpisodeBatch,
    EpisodeRolloutBuffer,
    ProgressTracker,
    RolloutSize,
)
from sb3_crpn.episodes.batch import discount_factors
from sb3_crpn.episodes.running_moments import frozen_moments
from sb3_crpn.episodes.time_limits import EPISODE_LIMIT, has_time_limit
from sb3_crpn.policy import state_values
from sb3_crpn.progress import Tick


@contextmanager
def preserve_state(policy: ActorCriticPolicy, env: VecEnv, seed: int) -> Iterator[None]:
    """Put ``policy`` in evaluation mode with its own random stream, and restore the state.

    The state is the policy's mode, its action distribution, PyTorch's generators, and the
    ``training`` flag of a ``VecNormalize``. SB3's policies reuse one distribution object. With gSDE
    it holds the exploration noise of the rollout in progress.
    """
    training, distribution = policy.training, dict(vars(policy.action_dist))
    devices = [policy.device] if policy.device.type == "cuda" else []
    with torch.random.fork_rng(devices=devices), frozen_moments(env):
        try:
            torch.manual_seed(seed)
            policy.set_training_mode(False)
            yield
        finally:
            policy.set_training_mode(training)
            vars(policy.action_dist).clear()
            vars(policy.action_dist).update(distribution)


def collect_episodes(
    policy: ActorCriticPolicy,
    env: VecEnv,
    n_episodes: int,
    *,
    gamma: float,
    horizon: int | None = None,
    tick: Tick = lambda n: None,
) -> EpisodeBatch:
    """Simulate whole episodes of the stochastic policy, a fixed quota from each environment.

    The cost advantages are the costs-to-go, A_i = Ψ_i = -Σ_{h≥i} γ^h r_h, without an estimate of
    the critic. A time limit ends an episode.

    Parameters
    ----------
    policy
        In evaluation mode. Actions are drawn from PyTorch's generator. With gSDE the noise is drawn
        anew at each step, so that the actions are independent samples of π(a|s).
    env
        Reset at the start.
    n_episodes
        Number of episodes of all environments together.
    gamma
        γ.
    horizon
        Maximum length of an episode in steps. ``None``: no limit but the environment's.
    tick
        Called at the end of each episode.

    Raises
    ------
    ValueError
        A reward is not finite, or no episode ends within ``EPISODE_LIMIT`` steps where no time
        limit is known.
    """
    collector = Collector(
        policy, env, bootstrap_truncated=False, uses_critic=False, sde_sample_freq=1
    )
    if horizon is None and not has_time_limit(env):
        collector.expect_an_end_within(EPISODE_LIMIT)
    collector.reset()
    buffer = _new_buffer(policy, env.num_envs, gamma)
    size = RolloutSize(n_steps=0, n_episodes=n_episodes, horizon=horizon)
    collector.collect(buffer, ProgressTracker(tick), size)
    return buffer.episode_batch(baseline=False, normalize_advantage=False, discount_visitation=True)


def with_baseline(policy: ActorCriticPolicy, batch: EpisodeBatch, gamma: float) -> EpisodeBatch:
    """Return the batch with A_i = Ψ_i + γ^i V(s_i).

    Gradient and Hessian stay unbiased, since V was fitted on other episodes (DESIGN section 2).
    """
    with torch.no_grad():
        values = state_values(policy, batch.observations).cpu().double().numpy()
    baseline = discount_factors(gamma, batch.lengths) * values
    return replace(batch, cost_advantages=batch.cost_advantages + baseline)


def _new_buffer(policy: ActorCriticPolicy, n_envs: int, gamma: float) -> EpisodeRolloutBuffer:
    is_dict = isinstance(policy.observation_space, spaces.Dict)
    buffer_class: type[EpisodeRolloutBuffer] = (
        DictEpisodeRolloutBuffer if is_dict else EpisodeRolloutBuffer
    )
    return buffer_class(
        256,  # initial capacity
        policy.observation_space,
        policy.action_space,
        device=policy.device,
        gamma=gamma,
        gae_lambda=1.0,
        n_envs=n_envs,
    )
