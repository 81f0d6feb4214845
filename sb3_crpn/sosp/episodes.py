"""Whole episodes of any SB3 actor-critic policy, which is left exactly as it was."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_crpn.episodes import (
    Collector,
    DictEpisodeRolloutBuffer,
    EpisodeBatch,
    EpisodeRolloutBuffer,
    RolloutSize,
    TickingTracker,
)
from sb3_crpn.episodes.batch import discount_factors
from sb3_crpn.policy import state_values
from sb3_crpn.progress import Tick


@contextmanager
def preserve_state(policy: ActorCriticPolicy, env: VecEnv, seed: int) -> Iterator[None]:
    """Put ``policy`` in evaluation mode on a random stream of its own, then undo all of it.

    Kept are the mode, the action distribution (SB3's policies reuse one object; with gSDE it holds
    the exploration noise of the rollout in progress), PyTorch's generators, and whether a
    ``VecNormalize`` learns its statistics.
    """
    training, distribution = policy.training, dict(vars(policy.action_dist))
    normalizer = unwrap_vec_normalize(env)
    learns = normalizer is not None and normalizer.training
    devices = [policy.device] if policy.device.type == "cuda" else []
    with torch.random.fork_rng(devices=devices):
        try:
            torch.manual_seed(seed)
            policy.set_training_mode(False)
            if normalizer is not None:
                normalizer.training = False
            yield
        finally:
            policy.set_training_mode(training)
            vars(policy.action_dist).clear()
            vars(policy.action_dist).update(distribution)
            if normalizer is not None:
                normalizer.training = learns


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

    The weights are the costs-to-go, A_i = Ψ_i = -Σ_{h≥i} γ^h r_h: no estimate enters them. A time
    limit is an episode's end.

    Parameters
    ----------
    policy
        In evaluation mode; its actions are drawn from PyTorch's generator. With gSDE the noise is
        drawn anew for each step, as π(a|s) has it.
    env
        Reset at the start.
    n_episodes
        Episodes in all.
    gamma
        γ.
    horizon
        Steps after which an episode is cut; ``None``: never.
    tick
        Told of each episode that has ended.

    Raises
    ------
    ValueError
        A reward is not finite, or no episode comes to an end.
    """
    collector = Collector(
        policy, env, bootstrap_truncated=False, uses_critic=False, sde_sample_freq=1
    )
    collector.reset()
    buffer = _new_buffer(policy, env.num_envs, gamma)
    size = RolloutSize(n_steps=0, n_episodes=n_episodes, horizon=horizon)
    collector.collect(buffer, TickingTracker(tick), size)
    return buffer.episode_batch(baseline=False, normalize_advantage=False, discount_visitation=True)


def with_baseline(policy: ActorCriticPolicy, batch: EpisodeBatch, gamma: float) -> EpisodeBatch:
    """Return the batch with A_i = Ψ_i + γ^i V(s_i).

    Unbiased for the gradient and the Hessian, since V, whatever it is, was fitted on other
    episodes than these (DESIGN section 2).
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
        256,  # grows
        policy.observation_space,
        policy.action_space,
        device=policy.device,
        gamma=gamma,
        gae_lambda=1.0,
        n_envs=n_envs,
    )
