"""Whole training runs, relative to TRPO at as many steps."""

from __future__ import annotations

import itertools
from typing import Any

import gymnasium as gym
from sb3_contrib import TRPO
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from benchmarks.common.table import Row
from benchmarks.speed.timing import Task, compare
from sb3_crpn import ACRPN, CRPN

ENVS = ("CartPole-v1", "Pendulum-v1")


def measure(repeats: int = 6, timesteps: int = 20_480, warm_ups: int = 1) -> list[Row]:
    """Compare the time per timestep of ``learn``, each turn with another seed.

    TRPO runs with its own defaults ("TRPO") and with CRPN's rollout length and critic work
    ("TRPO, same critic"), which is the unit.
    """
    rows = []
    for env in ENVS:
        model = CRPN("MlpPolicy", env, device="cpu")
        critic = {name: getattr(model, name) for name in ("batch_size", "n_critic_updates")}
        same = {"n_steps": _multiple(model.n_steps, model.batch_size), **critic}
        tasks = {
            "TRPO, same critic": _learn(TRPO, env, timesteps, same),
            "TRPO": _learn(TRPO, env, timesteps, {}),
            "CRPN": _learn(CRPN, env, timesteps, {}),
            "ACRPN": _learn(ACRPN, env, timesteps, {}),
        }
        case = {"env": env, "timesteps": timesteps}
        rows.append(compare(case, tasks, "TRPO, same critic", repeats, warm_ups))
    return rows


def _learn(
    algorithm: type[OnPolicyAlgorithm], env: str, timesteps: int, arguments: dict[str, Any]
) -> Task:
    seeds = itertools.count()
    models: list[OnPolicyAlgorithm] = []

    def prepare() -> None:
        model = algorithm("MlpPolicy", gym.make(env), seed=next(seeds), device="cpu", **arguments)
        models[:] = [model]

    def run() -> float:
        return float(models[0].learn(timesteps).num_timesteps)

    return Task(run, prepare)


def _multiple(number: int, factor: int) -> int:
    """Return ``number`` rounded to a multiple of ``factor``: TRPO warns of others."""
    return factor * max(1, round(number / factor))
