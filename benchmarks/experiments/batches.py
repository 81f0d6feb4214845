"""Updates to a level against the timesteps of an update, with the Hessian and without.

    python -m benchmarks.experiments.batches

The noise of a Hessian falls with the batch, that of a long step's error does not: if curvature pays
anywhere, it is where updates are large. PPO, TRPO, CRPN and CRPN without the Hessian learn from 64
environments side by side, with the same network, γ, λ and critic work, rollouts of timesteps and no
reuse, each at several ``target_kl``. A run is at the level when the mean return of its latest 64
training episodes is.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from sb3_contrib import TRPO
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from benchmarks.common.figures import PALETTE
from benchmarks.common.intervals import interval
from benchmarks.common.markdown import estimate, markdown
from benchmarks.common.table import Row
from benchmarks.experiments.study import Study
from sb3_crpn import CRPN
from sb3_crpn.vec_env import GymnasiumVecEnv

N_ENVS = 64


class Task(NamedTuple):
    """The mean return to reach, and the discount."""

    level: float
    gamma: float
    vectorization: str = "sync"


TASKS = {
    "Pendulum-v1": Task(-200.0, 0.9),
    "CartPole-v1": Task(475.0, 0.98, "vector_entry_point"),
    "Acrobot-v1": Task(-100.0, 0.99),
}
# Timesteps of an update, and the updates after which a run is given up
UPDATES = {2_048: 150, 16_384: 60, 65_536: 40}
KLS = (0.02, 0.08, 0.3)
# Critic's work for a timestep, the same for CRPN and TRPO
_CRITIC = {"learning_rate": 1e-3, "n_critic_updates": 10}
_CRPN = _CRITIC | {"rollout": "timesteps", "n_reused_rollouts": 0}
LEARNERS: dict[str, tuple[type[OnPolicyAlgorithm], dict[str, Any]]] = {
    "CRPN": (CRPN, _CRPN),
    "no Hessian": (CRPN, _CRPN | {"hessian_shrinkage": 0.0}),
    "TRPO": (TRPO, _CRITIC | {"cg_max_steps": 10}),
    "PPO": (PPO, {"n_epochs": 10}),
}
N_MINIBATCHES = 32


def jobs(seeds: int) -> list[Row]:
    """Return one job per training run."""
    cases = itertools.product(range(seeds), UPDATES, TASKS, KLS, LEARNERS)
    return [
        {"env": env, "batch": batch, "learner": learner, "target_kl": kl, "seed": seed}
        for seed, batch, env, kl, learner in cases
    ]


def measure(env: str, batch: int, learner: str, target_kl: float, seed: int) -> list[Row]:
    """Train once."""
    task = TASKS[env]
    vector = gym.make_vec(env, N_ENVS, vectorization_mode=task.vectorization)
    algorithm, arguments = LEARNERS[learner]
    model: Any = algorithm(
        "MlpPolicy",  # type: ignore[arg-type]
        GymnasiumVecEnv(vector),
        n_steps=batch // N_ENVS,
        batch_size=batch // N_MINIBATCHES,  # type: ignore[call-arg]
        target_kl=target_kl,  # type: ignore[call-arg]
        gamma=task.gamma,
        gae_lambda=0.95,
        seed=seed,
        device="cpu",
        **arguments,
    )
    until = UntilLevel(task.level, UPDATES[batch])
    model.learn(10**12, callback=until)
    model.get_env().close()
    return [{"updates": until.updates, "reached": int(until.reached), "curve": until.curve}]


class UntilLevel(BaseCallback):
    """Stops before the update that would follow a level, or a number of updates.

    Attributes
    ----------
    curve
        Mean return of the latest ``N_ENVS`` episodes before each update.
    reached
        Whether the last one is at the level.
    """

    def __init__(self, level: float, max_updates: int) -> None:
        super().__init__()
        self.curve: list[float] = []
        self.reached = False
        self._level, self._max_updates = level, max_updates
        self._returns: deque[float] = deque(maxlen=N_ENVS)

    @property
    def updates(self) -> int:
        """Updates made."""
        return len(self.curve) - 1

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                self._returns.append(float(info["episode"]["r"]))
        # the step that a stopped rollout has begun is the only one beyond the last update
        return not self.reached and self.updates < self._max_updates

    def _on_rollout_end(self) -> None:
        full = len(self._returns) == N_ENVS
        self.curve.append(float(np.mean(self._returns)) if full else float("nan"))
        self.reached = full and self.curve[-1] >= self._level


def best(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of each learner's best ``target_kl``: least updates, then best curve."""
    chosen = []
    for _, group in rows.groupby(["env", "batch", "learner"], sort=False):
        kls = {kl: _score(runs) for kl, runs in group.groupby("target_kl")}
        chosen.append(group[group.target_kl == min(kls, key=kls.__getitem__)])
    return pd.concat(chosen)


def _score(runs: pd.DataFrame) -> tuple[float, float]:
    return float(runs.updates.mean()), -float(np.mean([np.nanmean(c) for c in runs.curve]))


def table(rows: pd.DataFrame) -> str:
    """Return a Markdown table of the updates to the level, a row per task, batch and target."""
    body = []
    for (env, batch, kl), group in rows.groupby(["env", "batch", "target_kl"], sort=True):
        body.append([env, f"{batch:,}", f"{kl:g}", *_cells(group)])
    for (env, batch), group in best(rows).groupby(["env", "batch"], sort=True):
        body.append([env, f"{batch:,}", "best", *_cells(group)])
    return markdown(["task", "timesteps", "target_kl", *LEARNERS], body)


def _cells(group: pd.DataFrame) -> list[str]:
    cells = []
    for learner in LEARNERS:
        runs = group[group.learner == learner]
        if runs.empty:
            cells.append("-")
            continue
        all_there = "" if runs.reached.all() else f" ({runs.reached.sum()} of {len(runs)})"
        cells.append(estimate(interval(runs.updates), ".1f") + all_there)
    return cells


def draw(rows: pd.DataFrame) -> Figure:
    """Draw updates to the level against the batch, a panel a task; print the table."""
    rows = rows.assign(curve=rows.curve.map(parse_curve))
    print(table(rows))
    chosen = best(rows)
    figure, axes = plt.subplots(1, len(TASKS), figsize=(9, 3.2), layout="constrained")
    for axis, env in zip(axes, TASKS, strict=True):
        _draw_task(axis, chosen[chosen.env == env])
        axis.set_title(f"{env} to {TASKS[env].level:g}", fontsize=9)
        axis.set_xlabel("timesteps of an update")
    axes[0].set_ylabel("updates, each at its best target_kl")
    axes[0].legend()
    return figure


def _draw_task(axis: Axes, rows: pd.DataFrame) -> None:
    for colour, learner in zip(PALETTE, LEARNERS, strict=False):
        groups = list(rows[rows.learner == learner].groupby("batch"))
        if not groups:
            continue
        means = np.array([interval(group.updates) for _, group in groups])
        batches: Sequence[Any] = [batch for batch, _ in groups]
        errors = np.abs(means[:, 1:].T - means[:, 0])
        axis.errorbar(batches, means[:, 0], errors, fmt="o-", color=colour, label=learner)
    axis.set_xscale("log")
    axis.set_yscale("log")


def parse_curve(text: str) -> list[float]:
    """Return the curve of a CSV's cell."""
    return [float(value) for value in text.strip("[]").split(",")]


STUDY = Study("batches", jobs, measure, draw, seeds=3)

if __name__ == "__main__":
    STUDY.main(str(__doc__))
