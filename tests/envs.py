"""Small environments: a deterministic walk, arbitrary spaces, and injected faults."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class Drift(gym.Env):
    """A walk on a line from 0 that ends at ``bound`` or after ``limit`` steps.

    Nothing is random but the policy: runs with the same actions are the same bit for bit, and
    so are all first observations. ``total`` counts the steps ever taken.
    """

    def __init__(self, bound=1.5, limit=12.0, dim=0):
        self.bound, self.limit = bound, limit
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (dim,)) if dim else spaces.Discrete(2)
        self.total = self.resets = 0

    def _observe(self):
        return np.array([self.x, 1.0 - self.steps / 10.0], np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.steps = 0.0, 0
        self.resets += 1
        return self._observe(), {}

    def step(self, action):
        push = float(np.mean(action)) if self.action_space.shape else 2.0 * float(action) - 1.0
        self.x += 0.4 * push + 0.05
        self.steps += 1
        self.total += 1
        reward = 1.0 + 0.5 * push - self.x**2
        return self._observe(), reward, abs(self.x) >= self.bound, self.steps >= self.limit, {}


class Sampler(gym.Env):
    """Random observations of any space, and rewards that grow with the size of the action."""

    def __init__(self, observation_space, action_space, length=4):
        self.observation_space, self.action_space = observation_space, action_space
        self.length = length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self.steps += 1
        done = self.steps >= self.length
        return self.observation_space.sample(), float(np.mean(action)), done, False, {}


class Faulty(gym.Wrapper):
    """``fault(observation, reward, *rest)`` replaces the outcome of step number ``at``."""

    def __init__(self, env, at, fault):
        super().__init__(env)
        self.at, self.fault = at, fault

    def step(self, action):
        outcome = self.env.step(action)
        return self.fault(*outcome) if self.unwrapped.total == self.at else outcome


class FaultyReset(gym.Wrapper):
    """Every episode begins with NaN."""

    def reset(self, **kwargs):
        observation, info = self.env.reset(**kwargs)
        return np.full_like(observation, np.nan), info


class Rewards(gym.RewardWrapper):
    """Rewards times ``factor``."""

    def __init__(self, env, factor):
        super().__init__(env)
        self.factor = factor

    def reward(self, reward):
        return self.factor * reward
