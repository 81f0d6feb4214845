"""Many environments: rollouts and updates per timestep, relative to TRPO."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
from sb3_contrib import TRPO
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from benchmarks.common.table import Row
from benchmarks.speed.timing import Task, compare
from benchmarks.speed.updates import update_task
from sb3_crpn import CRPN
from sb3_crpn.vec_env import GymnasiumVecEnv


def _vector(n_envs: int) -> VecEnv:
    vector = gym.make_vec("CartPole-v1", n_envs, vectorization_mode="vector_entry_point")
    return GymnasiumVecEnv(vector)


def _processes(n_envs: int) -> VecEnv:
    fork = {"start_method": "fork"}  # none of them imports anything
    return make_vec_env(
        "HalfCheetah-v5", n_envs, seed=0, vec_env_cls=SubprocVecEnv, vec_env_kwargs=fork
    )


# Environment, number, kind of VecEnv, and what makes it
CASES: tuple[tuple[str, int, str, Callable[[int], VecEnv]], ...] = (
    ("CartPole-v1", 64, "GymnasiumVecEnv", _vector),
    ("HalfCheetah-v5", 16, "DummyVecEnv", lambda n: make_vec_env("HalfCheetah-v5", n, seed=0)),
    ("HalfCheetah-v5", 16, "SubprocVecEnv", _processes),
)
# By default CRPN reuses three rollouts. The others learn from the new rollout only
LEARNERS: dict[str, tuple[type[OnPolicyAlgorithm], dict[str, Any]]] = {
    "TRPO": (TRPO, {}),
    "PPO": (PPO, {}),
    "CRPN": (CRPN, {"rollout": "timesteps", "n_reused_rollouts": 0}),
}


def measure(repeats: int = 12, n_steps: int = 2048, n_cases: int = len(CASES)) -> list[Row]:
    """Compare rollouts of ``n_steps`` timesteps in all, and updates of all and of the actor alone.

    Minibatches and passes of the critics are the algorithms' defaults; PPO has no actor alone, and
    its whole update stands there too. The learners share the environments.
    """
    rows = []
    for name, n_envs, kind, make in CASES[:n_cases]:
        env = make(n_envs)
        arguments: dict[str, Any] = {"n_steps": n_steps // n_envs, "seed": 0, "device": "cpu"}
        models = {
            learner: algorithm("MlpPolicy", env, **arguments, **extra)
            for learner, (algorithm, extra) in LEARNERS.items()
        }
        parts = {
            "rollout": {key: _rollout(model) for key, model in models.items()},
            "update": {key: _update(model) for key, model in models.items()},
            "actor": {key: _update(model, critic=False) for key, model in models.items()},
        }
        for part, tasks in parts.items():
            case = {"env": name, "n_envs": n_envs, "VecEnv": kind, "part": part, "T": n_steps}
            rows.append(compare(case, tasks, "TRPO", repeats))
        env.close()
    return rows


def _rollout(model: OnPolicyAlgorithm) -> Task:
    """Return the next rollout of an unchanging policy; its work is its timesteps."""
    callback = model._setup_learn(1)[1]

    def run() -> float:
        before = model.num_timesteps
        model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)
        return float(model.num_timesteps - before)

    run()  # an update needs a rollout
    return Task(run)


def _update(model: OnPolicyAlgorithm, *, critic: bool = True) -> Task:
    """Return the update from the present rollout. Its work is the rollout's timesteps."""
    task = update_task(model, critic=critic)

    def run() -> float:
        task.run()
        return float(model.n_steps * model.n_envs)

    return Task(run, task.prepare)
