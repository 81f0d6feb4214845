"""A TabularMDP as a Gymnasium environment, one episode at a time or many."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from benchmarks.exact.mdp import TabularMDP

Array = NDArray[Any]


class _Dynamics:
    """Draws states and returns rewards and one-hot observations, vectorised."""

    def __init__(self, mdp: TabularMDP) -> None:
        self.observation_space = spaces.Box(0.0, 1.0, (mdp.n_observations,), np.float32)
        self.action_space = spaces.Discrete(mdp.n_actions)
        self.reward = mdp.reward.numpy()
        self._stop = None if mdp.stop is None else mdp.stop.numpy()
        self._initial = mdp.initial.cumsum(0).numpy()
        self._transition = mdp.transition.cumsum(2).numpy()
        self._seen = np.eye(mdp.n_observations, dtype=np.float32)[mdp.observation.numpy()]

    def first(self, rng: np.random.Generator, n: int) -> Array:
        return self._draw(self._initial[None], rng, n)

    def after(self, rng: np.random.Generator, states: Array, actions: Array) -> Array:
        return self._draw(self._transition[states, actions], rng, len(states))

    def stops(self, rng: np.random.Generator, states: Array, actions: Array) -> Array:
        if self._stop is None:
            return np.zeros(len(states), dtype=bool)
        stops: Array = rng.random(len(states)) < self._stop[states, actions]
        return stops

    def see(self, states: Array) -> Array:
        return self._seen[states]

    @staticmethod
    def _draw(cumulative: Array, rng: np.random.Generator, n: int) -> Array:
        # no sample exceeds the last bound, which is 1 up to rounding
        drawn: Array = (rng.random((n, 1)) >= cumulative[:, :-1]).sum(1)
        return drawn


class TabularEnv(gym.Env[Array, int]):
    """Simulates a :class:`TabularMDP`. Episodes stop at random, or after step H."""

    def __init__(self, mdp: TabularMDP) -> None:
        self._dynamics, self._horizon = _Dynamics(mdp), mdp.horizon
        self.observation_space = self._dynamics.observation_space
        self.action_space = self._dynamics.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Draw s_0."""
        super().reset(seed=seed)
        self._time, self._state = 0, self._dynamics.first(self.np_random, 1)
        return self._dynamics.see(self._state)[0], {}

    def step(self, action: int) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Take one step."""
        self._time += 1
        actions = np.array([action])
        reward = self._dynamics.reward[self._state, actions].item()
        stops = self._dynamics.stops(self.np_random, self._state, actions).item()
        self._state = self._dynamics.after(self.np_random, self._state, actions)
        observation = self._dynamics.see(self._state)[0]
        return observation, reward, stops or self._time == self._horizon, False, {}


class TabularVectorEnv(VectorEnv[Array, Array, Array]):
    """Simulates ``num_envs`` episodes in parallel, which begin and end together.

    Raises
    ------
    ValueError
        Episodes may stop before step H.
    """

    metadata: ClassVar[dict[str, Any]] = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, mdp: TabularMDP, num_envs: int) -> None:
        if mdp.stop is not None:
            raise ValueError("TabularVectorEnv: mdp.stop is not allowed, must be None")
        self._dynamics, self._horizon = _Dynamics(mdp), mdp.horizon
        self.num_envs = num_envs
        self.single_observation_space = self._dynamics.observation_space
        self.single_action_space = self._dynamics.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Draw s_0 of every episode."""
        super().reset(seed=seed)
        self._time, self._states = 0, self._dynamics.first(self.np_random, self.num_envs)
        return self._dynamics.see(self._states), {}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Take one step in each episode, and begin new episodes after the last one."""
        self._time += 1
        rewards = self._dynamics.reward[self._states, actions]
        self._states = self._dynamics.after(self.np_random, self._states, actions)
        observations, infos = self._dynamics.see(self._states), {}
        ended = self._time == self._horizon
        if ended:
            infos["final_obs"] = observations
            observations, _ = self.reset()
        terminated = np.full(self.num_envs, ended)
        return observations, rewards, terminated, np.zeros_like(terminated), infos
