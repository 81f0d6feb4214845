"""Rollouts of whole episodes: quotas, horizons, resets and estimates during training."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_crpn import CRPN
from sb3_crpn.episodes import (
    collector,
)
from sb3_crpn.episodes.batch import episode_time
from tests.mdp import random_mdp, random_parameters, tabular_crpn


class Clock(gym.Env):
    """Observes the time, has the reward 1 a step, and terminates after given numbers of steps."""

    action_space = spaces.Discrete(2)
    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)

    def __init__(self, durations=(np.inf,)):
        self.durations = list(durations)
        self.n_resets = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        self.duration = self.durations[self.n_resets % len(self.durations)]
        self.n_resets += 1
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.time += 1
        observation = np.array([self.time], np.float32)
        return observation, 1.0, self.time >= self.duration, False, {}


class Updates(BaseCallback):
    """Records of the rollouts."""

    def __init__(self):
        super().__init__()
        self.lengths, self.timesteps, self.used = [], [], []

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        self.lengths.append(self.model.rollout_buffer.lengths.tolist())
        self.timesteps.append(self.num_timesteps)
        self.used.append(self.model.rollouts.used_fraction)


def clock_crpn(*durations, monitor=True, **arguments):
    """A model on one Clock per sequence of durations, and the clocks."""
    clocks = [Clock(each) for each in durations]
    wrapped = [Monitor(clock, allow_early_resets=monitor) for clock in clocks]
    env = DummyVecEnv([lambda env=env: env for env in wrapped])
    settings = {"n_steps": 4, "policy_kwargs": {"net_arch": []}, "seed": 0, "device": "cpu"}
    return CRPN("MlpPolicy", env, **(settings | arguments)), clocks


def observed_time_is_episode_time(model):
    batch = model._batch(model.rollout_buffer)
    expected = episode_time(batch.lengths)
    return np.array_equal(batch.observations.flatten().numpy(), expected)


def test_timesteps_are_counted_whether_they_are_used_or_not():
    model, _ = clock_crpn([2], [7], n_episodes=2)
    updates = Updates()
    model.learn(30, callback=updates)
    assert updates.lengths == [[2, 7]] * 3
    assert updates.timesteps == [14, 28, 42]
    assert updates.used == pytest.approx([9 / 14] * 3)
    assert observed_time_is_episode_time(model)


def test_environments_in_mid_episode_are_reset_before_the_next_rollout():
    model, clocks = clock_crpn([3], [7], n_episodes=2)
    model.learn(20)
    assert observed_time_is_episode_time(model)
    assert clocks[1].time == 0
    assert clocks[0].n_resets == 1 + 2 + 1 + 2


@pytest.mark.parametrize("early_resets", [True, False])
def test_the_horizon_cuts_episodes(early_resets):
    model, _ = clock_crpn([9, 2], [5], n_episodes=4, horizon=3, monitor=early_resets)
    updates = Updates()
    model.learn(40, callback=updates)
    assert len(updates.lengths) > 1
    for lengths in updates.lengths:
        assert len(lengths) == 4
        assert set(lengths) <= {2, 3}
    assert observed_time_is_episode_time(model)


def test_the_horizon_makes_episodes_of_an_environment_that_never_ends():
    model, clocks = clock_crpn([np.inf], [np.inf], n_episodes=5, horizon=3)
    updates = Updates()
    model.learn(1, callback=updates)
    assert updates.lengths == [[3] * 5]
    assert updates.timesteps == [3 * 3 * 2]
    assert updates.used == pytest.approx([15 / 18])
    assert clocks[0].n_resets == 3
    assert observed_time_is_episode_time(model)


def test_an_environment_that_never_ends_is_an_error_that_names_the_way_out(monkeypatch):
    monkeypatch.setattr(collector, "ENDLESS", 50)
    model, _ = clock_crpn([np.inf], n_episodes=1)
    before = model.actor.vector
    with pytest.raises(ValueError, match=r"no episode ended within 50 steps.*horizon=H"):
        model.learn(1)
    assert torch.equal(model.actor.vector, before)


def test_a_monitor_that_forbids_early_resets_is_respected():
    model, _ = clock_crpn([2, 6], [5], [1, 3], n_episodes=4, monitor=False)
    updates = Updates()
    model.learn(60, callback=updates)
    assert len(updates.lengths) > 2
    assert all(len(lengths) == 4 for lengths in updates.lengths)
    assert observed_time_is_episode_time(model)
    assert model.num_timesteps == updates.timesteps[-1]


def test_the_quota_depends_on_the_past_alone():
    model, _ = clock_crpn([10] + [2] * 5 + [50] * 99, n_steps=10)
    updates = Updates()
    model.learn(500, callback=updates)
    assert updates.lengths[:2] == [[10], [2]]
    assert updates.lengths[2] == [2, 2, 2, 2, 50]
    assert updates.lengths[3] == [50]


def test_the_buffer_outgrows_n_steps():
    model, _ = clock_crpn([37], n_steps=2, n_episodes=2)
    model.learn(1)
    assert model.rollout_buffer.lengths.tolist() == [37, 37]
    assert observed_time_is_episode_time(model)


@pytest.mark.parametrize("n_episodes", [1, 5, 8, 11])
def test_any_number_of_episodes_over_the_environments(n_episodes):
    model = tabular_crpn(random_mdp(0), n_envs=4)
    model.estimate_curvature(3)
    batch = model.estimate_curvature(n_episodes).gradient_batch
    assert batch.n_episodes == n_episodes
    assert model.num_timesteps == 0


class EstimateOnce(BaseCallback):
    def __init__(self, env):
        super().__init__()
        self.env, self.estimate = env, None

    def _on_step(self):
        if self.estimate is None:
            self.estimate = self.model.estimate_curvature(3, env=self.env)
        return True


def test_a_callback_may_estimate_in_an_environment_of_its_own():
    model, _ = clock_crpn([2], [7], n_episodes=2)
    updates, inside = Updates(), EstimateOnce(DummyVecEnv([lambda: Clock([3])]))
    model.learn(30, callback=[updates, inside])
    assert inside.estimate.gradient_batch.lengths.tolist() == [3, 3, 3]
    assert updates.lengths == [[2, 7]] * 3
    assert updates.timesteps == [14, 28, 42]
    assert observed_time_is_episode_time(model)


def test_a_callback_may_not_estimate_in_the_environment_of_the_rollout():
    model, _ = clock_crpn([2], [7], n_episodes=2)
    with pytest.raises(RuntimeError, match="in the middle of a rollout"):
        model.learn(30, callback=EstimateOnce(None))
    model.learn(30)
    assert observed_time_is_episode_time(model)


def test_the_training_environment_may_be_named():
    model, clocks = clock_crpn([2] + [7] * 9, [2] + [6] * 9, n_episodes=2)
    model.learn(1)
    model.estimate_curvature(3, env=model.env)
    assert clocks[0].n_resets > 2
    model.learn(1, reset_num_timesteps=False)
    assert observed_time_is_episode_time(model)


class AsDict(gym.ObservationWrapper):
    def __init__(self, env):
        super().__init__(env)
        self.observation_space = spaces.Dict({"state": env.observation_space})

    def observation(self, observation):
        return {"state": observation}


def test_dict_observations_give_the_same_estimate():
    mdp = random_mdp(0)
    plain = tabular_crpn(mdp)
    wrapped = tabular_crpn(mdp, wrapper=AsDict, policy="MultiInputPolicy")
    theta = random_parameters(mdp)
    estimates = []
    for model in (plain, wrapped):
        model.set_random_seed(3)
        model.env.seed(3)
        model.actor.assign(theta)
        estimates.append(model.estimate_curvature(20))
    expected, estimate = estimates
    assert isinstance(estimate.gradient_batch.observations, dict)
    torch.testing.assert_close(estimate.gradient, expected.gradient)
    torch.testing.assert_close(estimate.hessian.to_dense(), expected.hessian.to_dense())
