"""Rollouts of whole episodes, relative to SB3's rollouts of as many steps."""

from __future__ import annotations

from typing import Any

from sb3_contrib import TRPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from benchmarks.common.table import Row
from benchmarks.speed.timing import Task, compare
from sb3_crpn import CRPN

TASKS = (("CartPole-v1", 1), ("CartPole-v1", 8), ("Pendulum-v1", 1), ("Pendulum-v1", 8))


def measure(repeats: int = 20, n_steps: int = 2048) -> list[Row]:
    """Compare the time per simulated step; ``kept`` is the share of them in whole episodes.

    Both sides store the steps and end with values and advantages. SB3's ``collect_rollouts`` is
    run as TRPO inherits it.
    """
    rows = []
    for env, n_envs in TASKS:
        arguments: dict[str, Any] = {"n_steps": n_steps // n_envs, "seed": 0, "device": "cpu"}
        ours = CRPN("MlpPolicy", make_vec_env(env, n_envs, seed=0), **arguments)
        theirs = TRPO(
            "MlpPolicy", make_vec_env(env, n_envs, seed=0), **arguments, batch_size=n_envs
        )
        kept: list[float] = []
        tasks = {"SB3": _collect(theirs, []), "CRPN": _collect(ours, kept)}
        row = compare({"env": env, "n_envs": n_envs, "T": n_steps}, tasks, "SB3", repeats)
        rows.append(row | {"kept": sum(kept) / len(kept)})
    return rows


def _collect(model: OnPolicyAlgorithm, kept: list[float]) -> Task:
    """Return the next rollout of an unchanging policy, with its steps as the work done."""
    callback = model._setup_learn(1)[1]

    def run() -> float:
        before = model.num_timesteps
        model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)
        kept.append(model.rollouts.used_fraction if isinstance(model, CRPN) else 1.0)
        return float(model.num_timesteps - before)

    return Task(run)
