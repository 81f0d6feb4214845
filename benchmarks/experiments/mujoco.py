"""The paper's algorithm on its continuous tasks at its settings, and why it does not learn.

    python -m benchmarks.experiments.mujoco

Reacher-v5 and Humanoid-v5 with tanh networks of 32-32 and 64-64 units, 100 episodes an update,
α = 10⁴, γ = 0.99, no baseline: the entries of ``zoo_configs/crpn_paper.yml``. Beside it one change
at a time, REINFORCE from the same episodes and CRPN's default arguments, all for as many timesteps.

Before the first and after the last update two more batches of 100 episodes are simulated: the
leftmost eigenvector v of one batch's Hessian H is confirmed where another batch's H' has as much
curvature along it, vᵀH'v/λ_min(H) = 1, and noise where that ratio is about 0. The ratio is missing
where the last policy's Hessian is not finite.
"""

from __future__ import annotations

import itertools
from contextlib import suppress
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.sparse.linalg import LinearOperator, eigsh
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from torch import nn

from benchmarks.common.figures import PALETTE
from benchmarks.common.markdown import markdown
from benchmarks.common.table import Row
from benchmarks.experiments.learners import PAPER_GRADIENT
from benchmarks.experiments.study import Study
from benchmarks.reinforce import REINFORCE
from sb3_crpn import CRPN, PAPER
from sb3_crpn.algorithm import PolicyNewtonAlgorithm
from sb3_crpn.curvature import CurvatureEstimate

N_EPISODES = 100
NET_ARCH = {"Reacher-v5": [32, 32], "Humanoid-v5": [64, 64]}
# Timesteps of a run: 10 updates of 5000 steps, and about 6 of 2500 as long as the humanoid falls
TIMESTEPS = {"Reacher-v5": 50_000, "Humanoid-v5": 15_000}
SETTING: dict[str, Any] = {"n_episodes": N_EPISODES, "gamma": 0.99}
THE_PAPERS = PAPER | SETTING | {"alpha": 1e4}
# With η = 10⁻³ REINFORCE's first step is about as long as CRPN's without the Hessian
LEARNERS: dict[str, tuple[type[PolicyNewtonAlgorithm], dict[str, Any]]] = {
    "CRPN, paper": (CRPN, THE_PAPERS),
    "REINFORCE": (REINFORCE, PAPER_GRADIENT | SETTING | {"actor_learning_rate": 1e-3}),
    "CRPN, defaults": (CRPN, {}),
    "no Hessian": (CRPN, THE_PAPERS | {"hessian_shrinkage": 0.0}),
    "alpha 1e6": (CRPN, THE_PAPERS | {"alpha": 1e6}),
}
LOGGED = ("gradient_norm", "gradient_noise", "step_norm", "multiplier", "lambda_min")


def jobs(seeds: int) -> list[Row]:
    """Return one job per training run, the comparison before the changes."""
    runs = [
        {"env": env, "learner": learner, "seed": seed}
        for seed in range(seeds)
        for learner in LEARNERS
        for env in TIMESTEPS
    ]
    return sorted(runs, key=lambda run: run["learner"] in ("no Hessian", "alpha 1e6"))


def measure(env: str, learner: str, seed: int, timesteps: int | None = None) -> list[Row]:
    """Train once; a row per update."""
    model = make_model(env, learner, seed)
    confirms = learner == "CRPN, paper"
    before = confirmed_share(model) if confirms else float("nan")
    updates = _Updates(TIMESTEPS[env] if timesteps is None else timesteps)
    model.learn(10**12, callback=updates)
    updates.rows[0]["confirmed"] = before
    if confirms:
        with suppress(ValueError):  # the Hessian of the last policy is not finite
            updates.rows[-1]["confirmed"] = confirmed_share(model)
    return updates.rows


def make_model(env: str, learner: str, seed: int) -> PolicyNewtonAlgorithm:
    """Return the learner, with the paper's network; its 100 episodes run ten at a time."""
    algorithm, arguments = LEARNERS[learner]
    n_envs = 10 if "n_episodes" in arguments else 1
    return algorithm(
        "MlpPolicy",
        make_vec_env(env, n_envs),
        policy_kwargs={"net_arch": NET_ARCH[env], "activation_fn": nn.Tanh},
        seed=seed,
        device="cpu",
        **arguments,
    )


def confirmed_share(model: PolicyNewtonAlgorithm) -> float:
    """Return vᵀH'v/λ_min(H), v of λ_min(H), from two independent batches at the same policy."""
    first, second = (model.estimate_curvature(N_EPISODES) for _ in range(2))
    value, vector = leftmost(first)
    return float(vector @ (second.hessian @ vector)) / value


def leftmost(estimate: CurvatureEstimate) -> tuple[float, torch.Tensor]:
    """Return λ_min(H) and its eigenvector [d], to 1 %."""
    d = len(estimate.gradient)
    operator = LinearOperator(
        (d, d), lambda v: (estimate.hessian @ torch.from_numpy(v.ravel())).numpy(), dtype=float
    )
    start = estimate.gradient.numpy()
    values, vectors = eigsh(operator, k=1, which="SA", tol=1e-2, v0=start)
    return float(values[0]), torch.from_numpy(vectors[:, 0].copy())


class _Updates(BaseCallback):
    """Records data and result of each update, and ends training after the last."""

    def __init__(self, timesteps: int) -> None:
        super().__init__()
        self.rows: list[Row] = []
        self._budget = timesteps
        self._returns: list[float] = []
        self._last = 0  # timesteps at the end of the last rollout

    def _on_rollout_start(self) -> None:
        if self._last:
            log = self.logger.name_to_value
            self.rows.append(
                {
                    "update": len(self.rows) + 1,
                    "timesteps": self._last,
                    "mean_return": float(np.mean(self._returns)),
                    **{name: log[f"train/{name}"] for name in LOGGED},
                    "kl_divergence": log["train/kl_divergence"],
                    "confirmed": float("nan"),
                }
            )
        self._returns = []

    def _on_step(self) -> bool:
        infos = self.locals["infos"]
        self._returns += [info["episode"]["r"] for info in infos if "episode" in info]
        return self._last < self._budget

    def _on_rollout_end(self) -> None:
        self._last = self.num_timesteps


def draw(rows: pd.DataFrame) -> Figure:
    """Draw the learning curves and the updates' divergences, and print the table."""
    print(table(rows))
    envs = [env for env in TIMESTEPS if env in set(rows.env)]
    size = (9, 3.2 * len(envs))
    figure, axes = plt.subplots(len(envs), 2, figsize=size, squeeze=False, layout="constrained")
    for row, env in zip(axes, envs, strict=True):
        chosen = rows[rows.env == env]
        _draw(row[0], chosen, "mean_return", f"{env}: mean return of an update's episodes")
        _draw(row[1], chosen, "kl_divergence", f"{env}: KL divergence of an update")
        row[1].set_yscale("log")
    axes[0, 0].legend(fontsize=7)
    return figure


def table(rows: pd.DataFrame) -> str:
    """Return a Markdown table: medians over all updates of all seeds, and the ends of training."""
    head = ["", "learner", "seeds", "updates", "first return", "last return", "‖g‖", "noise of g",
            "-λ_min(H)/multiplier", "step", "KL", "largest KL", "confirmed, before",
            "after"]  # fmt: skip
    body = []
    for env, learner in itertools.product(TIMESTEPS, LEARNERS):
        group = rows[(rows.env == env) & (rows.learner == learner)]
        if group.empty:
            continue
        runs = group.groupby("seed")
        cells = [
            f"{runs.ngroups}",
            f"{runs.size().median():.0f}",
            f"{runs.head(1).mean_return.mean():.4g}",
            f"{runs.tail(1).mean_return.mean():.4g}",
            _median(group.gradient_norm),
            _median(group.gradient_noise),
            _median(-group.lambda_min / group.multiplier),
            _median(group.step_norm),
            _median(group.kl_divergence),
            f"{group.kl_divergence.max():.2g}",
            *(_listed(end.confirmed) for end in (runs.head(1), runs.tail(1))),
        ]
        body.append([env, learner, *cells])
    return markdown(head, body)


def _median(values: pd.Series) -> str:
    return "-" if values.isna().all() else f"{values.median():.2g}"


def _listed(values: pd.Series) -> str:
    return ", ".join(f"{value:.2g}" for value in values.dropna()) or "-"


def _draw(axis: Axes, rows: pd.DataFrame, column: str, title: str) -> None:
    """Draw each run, with its learner's colour; the number of timesteps is its abscissa."""
    for colour, learner in zip(PALETTE, LEARNERS, strict=False):
        for seed, run in rows[rows.learner == learner].groupby("seed"):
            label = learner if seed == 0 else None
            axis.plot(run.timesteps, run[column], color=colour, lw=1, alpha=0.8, label=label)
    axis.set(xlabel="timesteps")
    axis.set_title(title, fontsize=9)


STUDY = Study("mujoco", jobs, measure, draw, seeds=3)

if __name__ == "__main__":
    STUDY.main(str(__doc__))
