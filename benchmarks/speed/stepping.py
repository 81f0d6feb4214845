"""Simulation in a ``gymnasium.vector`` environment, relative to SB3's ``DummyVecEnv``."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

from benchmarks.common.table import Row
from benchmarks.speed.timing import Task, compare
from sb3_crpn.vec_env import GymnasiumVecEnv

TASKS = (("CartPole-v1", 8), ("CartPole-v1", 64), ("CartPole-v1", 512))


def measure(repeats: int = 20, n_steps: int = 200) -> list[Row]:
    """Compare the time per step of one environment, with random actions and episode statistics."""
    rows = []
    for env, n_envs in TASKS:
        vector = gym.make_vec(env, n_envs, vectorization_mode="vector_entry_point")
        tasks = {
            "DummyVecEnv": _steps(make_vec_env(env, n_envs, seed=0), n_steps),
            "GymnasiumVecEnv": _steps(GymnasiumVecEnv(vector), n_steps),
        }
        rows.append(compare({"env": env, "n_envs": n_envs}, tasks, "DummyVecEnv", repeats))
    return rows


def _steps(env: VecEnv, n_steps: int) -> Task:
    """Return the task of stepping every environment."""
    env.seed(0)
    env.reset()
    env.action_space.seed(0)
    actions = np.array(
        [[env.action_space.sample() for _ in range(env.num_envs)] for _ in range(n_steps)]
    )

    def run() -> float:
        for action in actions:
            env.step(action)
        return float(n_steps * env.num_envs)

    return Task(run)
