"""One CRPN and one ACRPN update, relative to TRPO: same data, network and critic work."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from typing import Any

import torch
from sb3_contrib import TRPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from benchmarks.common.table import Row
from benchmarks.speed.problems import noise
from benchmarks.speed.timing import WARM_UPS, Task, compare
from sb3_crpn import ACRPN, CRPN
from sb3_crpn.algorithm import PolicyNewtonAlgorithm
from sb3_crpn.episodes import Replay

# Rollouts trained on before the one that is timed: α, Adam and any earlier rollouts are then as
# they are in the middle of training
WARM_UP_ROLLOUTS = 3

SETTINGS: dict[str, dict[str, Any]] = {"one rollout": {"n_reused_rollouts": 0}, "defaults": {}}

# State that training changes besides networks and optimiser
_MUTABLE = (bool, int, float, type(None), Replay)


def measure(
    repeats: int = 20, n_steps: int = 2048, n_envs: int = 2, warm_ups: int = WARM_UPS
) -> list[Row]:
    """Compare whole updates, and updates without the critic's fit.

    CartPole-v1 is the task itself in one environment, HalfCheetah-v5 noise of its shapes. "one
    rollout": without the earlier rollouts that join an update by default.
    """
    problems: dict[str, tuple[Callable[[], VecEnv], dict[str, Any]]] = {
        "CartPole-v1": (lambda: make_vec_env("CartPole-v1", seed=0), {"n_steps": n_steps}),
        "HalfCheetah-v5": (
            lambda: noise("HalfCheetah-v5", n_envs),
            {"n_steps": n_steps // n_envs, "horizon": n_steps // n_envs},
        ),
    }
    rows = []
    for name, (env, arguments) in problems.items():
        for setting, extra in SETTINGS.items():
            models = prepare(env, arguments | extra)
            steps = int(models["CRPN"].rollout_buffer.pos * models["CRPN"].n_envs)
            for part in ("update", "actor only"):
                case = {"problem": name, "setting": setting, "part": part, "T": steps}
                tasks = {
                    algorithm: update_task(model, critic=part == "update")
                    for algorithm, model in models.items()
                }
                rows.append(compare(case, tasks, "TRPO", repeats, warm_ups))
    return rows


def prepare(
    env: Callable[[], VecEnv], arguments: dict[str, Any], device: str = "cpu"
) -> dict[str, OnPolicyAlgorithm]:
    """Return the three models, each about to be trained on the same rollout of the same policy.

    CRPN learns for a few rollouts, and the others on those very rollouts; before each they take
    over its policy. TRPO's conjugate gradients, damping and line search are sb3-contrib's defaults.
    """
    common: dict[str, Any] = {"seed": 0, "device": device}
    leader = CRPN("MlpPolicy", env(), **common, **arguments)
    critic = {"batch_size": leader.batch_size, "n_critic_updates": leader.n_critic_updates}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="You have specified a mini-batch size")
        trpo = TRPO("MlpPolicy", env(), n_steps=leader.n_steps, **critic, **common)
    followers = [ACRPN("MlpPolicy", env(), **common, **arguments), trpo]
    callbacks = {model: model._setup_learn(1)[1] for model in (leader, *followers)}
    warm_ups = max(WARM_UP_ROLLOUTS, leader.n_reused_rollouts)
    for number in range(warm_ups + 1):
        for _ in range(2 if number == 0 else 1):  # the first tells how long the episodes are
            leader.collect_rollouts(
                leader.env, callbacks[leader], leader.rollout_buffer, leader.n_steps
            )
        for model in followers:
            model.policy.load_state_dict(leader.policy.state_dict())
            model.rollout_buffer = (
                copy.deepcopy(leader.rollout_buffer)
                if isinstance(model, PolicyNewtonAlgorithm)
                else _as_sb3(leader, model)
            )
        if number < warm_ups:
            for model in (*followers, leader):
                model.train()
    return {"TRPO": trpo, "CRPN": leader, "ACRPN": followers[0]}


def _as_sb3(leader: PolicyNewtonAlgorithm, model: OnPolicyAlgorithm) -> RolloutBuffer:
    """Return the leader's rollout in a buffer of SB3's."""
    source = leader.rollout_buffer
    buffer = RolloutBuffer(
        source.pos,
        leader.observation_space,
        leader.action_space,
        device=model.device,
        gae_lambda=model.gae_lambda,
        gamma=model.gamma,
        n_envs=source.n_envs,
    )
    for step in range(source.pos):
        buffer.add(
            source.observations[step],
            source.actions[step],
            source.rewards[step],
            source.episode_starts[step],
            torch.as_tensor(source.values[step]),
            torch.as_tensor(source.log_probs[step]),
        )
    dones = leader._last_episode_starts
    buffer.compute_returns_and_advantage(torch.zeros(source.n_envs), dones)
    return buffer


def update_task(model: OnPolicyAlgorithm, *, critic: bool) -> Task:
    """Return ``model.train()`` from the present state of the model."""
    policy = copy.deepcopy(model.policy.state_dict())
    optimizer = copy.deepcopy(model.policy.optimizer.state_dict())
    state = {name: value for name, value in vars(model).items() if isinstance(value, _MUTABLE)}
    state = copy.deepcopy(state)
    if not critic:
        state["n_critic_updates"] = 0

    def restore() -> None:
        model.policy.load_state_dict(policy)
        model.policy.optimizer.load_state_dict(optimizer)
        vars(model).update(copy.deepcopy(state))

    def run() -> None:
        with warnings.catch_warnings():
            # TRPO logs the mean loss of no minibatches
            warnings.filterwarnings("ignore", "(Mean of empty slice|invalid value)", RuntimeWarning)
            model.train()

    return Task(run, restore)
