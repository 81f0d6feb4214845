from functools import partial

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_crpn.episodes.batch import episode_starts, episode_time
from sb3_crpn.sosp import episodes
from sb3_crpn.sosp.episodes import collect_episodes, preserve_state, with_baseline
from tests.envs import Drift
from tests.training import several

GAMMA = 0.9


def policy_of(env, **arguments):
    return PPO("MlpPolicy", env, seed=0, device="cpu", gamma=GAMMA, **arguments).policy


def rewards_of(batch):
    """The rewards of the batch's actions, by a replay of the walk."""
    rewards, env = [], Drift()
    for action, first in zip(batch.actions, episode_time(batch.lengths) == 0, strict=True):
        if first:
            env.reset()
        rewards.append(env.step(action.item())[1])
    return np.array(rewards)


@pytest.mark.parametrize("horizon", [None, 5])
def test_weights_are_discounted_costs_to_go(horizon):
    env = several(3)
    batch = collect_episodes(policy_of(env), env, 7, gamma=GAMMA, horizon=horizon)
    assert batch.n_episodes == 7
    assert horizon is None or batch.lengths.max() <= horizon
    discounted = GAMMA ** episode_time(batch.lengths) * rewards_of(batch)
    for start, length in zip(episode_starts(batch.lengths), batch.lengths, strict=True):
        episode = slice(start, start + length)
        costs = -discounted[episode][::-1].cumsum()[::-1]
        np.testing.assert_allclose(batch.cost_advantages[episode], costs, rtol=1e-5, atol=1e-5)


def test_every_environment_has_its_quota():
    """Short episodes are not favoured: environments have equal quotas."""
    env = DummyVecEnv([Drift, partial(Drift, bound=0.2)])
    batch = collect_episodes(policy_of(env), env, 10, gamma=GAMMA)
    assert (batch.lengths == 1).sum() == 5


def test_the_baseline_is_the_critic():
    env = several(1)
    policy = policy_of(env)
    batch = collect_episodes(policy, env, 3, gamma=GAMMA)
    values = policy.predict_values(batch.observations).flatten().detach().numpy()
    added = with_baseline(policy, batch, GAMMA).cost_advantages - batch.cost_advantages
    np.testing.assert_allclose(added, GAMMA ** episode_time(batch.lengths) * values, rtol=1e-5)


def test_endless_episodes_end_with_an_error(monkeypatch):
    monkeypatch.setattr(episodes, "EPISODE_LIMIT", 100)
    env = several(2, bound=np.inf, limit=np.inf)
    with (
        pytest.warns(UserWarning, match="no episode has ended within 20 steps"),
        pytest.raises(ValueError, match=r"within 100 steps.*horizon=H.*TimeLimit"),
    ):
        collect_episodes(policy_of(env), env, 2, gamma=GAMMA)
    assert collect_episodes(policy_of(env), env, 2, gamma=GAMMA, horizon=300).n_steps == 600


def test_actions_reach_the_environment_within_its_bounds():
    env = several(1, dim=2)
    policy = policy_of(env)
    policy.log_std.data.fill_(2.0)
    seen = []
    step = env.step_async
    env.step_async = lambda actions: (seen.append(actions), step(actions))
    batch = collect_episodes(policy, env, 3, gamma=GAMMA)
    assert np.abs(seen).max() <= 1.0
    assert batch.actions.abs().max() > 1.0  # log π is that of the action drawn


@pytest.mark.parametrize("fails", [False, True])
def test_nothing_is_left_behind(fails):
    env = VecNormalize(several(1, dim=1))
    policy = policy_of(env, use_sde=True)
    policy.set_training_mode(True)
    policy.reset_noise()
    noise, state = policy.action_dist.exploration_mat, torch.get_rng_state()
    statistics = env.obs_rms.mean.copy()
    try:
        with preserve_state(policy, env, seed=1):
            assert not policy.training
            collect_episodes(policy, env, 2, gamma=GAMMA)
            assert policy.action_dist.exploration_mat is not noise
            if fails:
                raise RuntimeError
    except RuntimeError:
        assert fails
    assert policy.training
    assert env.training
    assert policy.action_dist.exploration_mat is noise
    assert torch.equal(torch.get_rng_state(), state)
    np.testing.assert_array_equal(env.obs_rms.mean, statistics)


def test_a_reward_that_is_no_number_is_an_error():
    env = several(1)
    env.step_wait = lambda wait=env.step_wait: (lambda o, r, d, i: (o, r * np.nan, d, i))(*wait())
    with pytest.raises(ValueError, match="non-finite reward"):
        collect_episodes(policy_of(env), env, 2, gamma=GAMMA)
