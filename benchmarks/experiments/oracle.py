"""The value of the Hessian in training, and of a better estimate of it.

    python -m benchmarks.experiments.oracle

Training with an environment's entry at a ``target_kl`` of 0.02 and at four times it, where a second
order should matter more. The Hessian of each update is

- ``none``: left out; ``own``: from the update's episodes, earlier rollouts included, as CRPN does;
- ``fresh``: from the fresh rollout alone;
- ``memory``: from the fresh rollout and eight previous ones;
- ``critic``: as ``own``, with the critic of :mod:`~benchmarks.experiments.critic_hessian`;
- ``confirmed``: shrunk, and with earlier rollouts or without, by the value on held-out episodes;
- ``4``, ``16``: from as many times the rollout's episodes, fresh and independent, which are not
  counted as training: an oracle.

Mean return over training, the CSV also has that of the last fifth. Seeds from 10 on, which no table
of the benchmark reports.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.common.figures import PALETTE
from benchmarks.common.intervals import interval
from benchmarks.common.markdown import estimate, markdown
from benchmarks.common.table import Row
from benchmarks.experiments.critic_hessian import CriticHessian
from benchmarks.experiments.hessians import (
    ConfirmedHessian,
    FreshHessian,
    MemoryHessian,
    OracleHessian,
)
from benchmarks.experiments.study import Study
from benchmarks.experiments.tasks import Returns, make_model
from sb3_crpn import CRPN

ALGORITHMS: dict[str, type[CRPN]] = {
    "none": CRPN,
    "own": CRPN,
    "fresh": FreshHessian,
    "memory": MemoryHessian,
    "critic": CriticHessian,
    "confirmed": ConfirmedHessian,
}
FACTORS = ("4", "16")
KLS = (0.02, 0.08)
HESSIANS = (*ALGORITHMS, *FACTORS)
FIRST_SEED = 10


class Task(NamedTuple):
    """The timesteps of a run, and the Hessians."""

    budget: int
    hessians: tuple[str, ...] = tuple(ALGORITHMS)


TASKS = {
    "CartPole-v1": Task(20_000, hessians=HESSIANS),
    "Pendulum-v1": Task(30_000, hessians=HESSIANS),
    "Acrobot-v1": Task(30_000),
}


def jobs(seeds: int) -> list[Row]:
    """Return one job per training run."""
    return [
        {"env": env, "target_kl": kl, "hessian": hessian, "seed": FIRST_SEED + seed}
        for seed, (env, task) in itertools.product(range(seeds), TASKS.items())
        for kl, hessian in itertools.product(KLS, task.hessians)
    ]


def measure(env: str, target_kl: float, hessian: str, seed: int) -> list[Row]:
    """Train once."""
    arguments = dict[str, Any](target_kl=target_kl)
    if hessian == "none":
        arguments["hessian_shrinkage"] = 0.0
    model = make_model(env, seed, ALGORITHMS.get(hessian, OracleHessian), **arguments)
    if isinstance(model, OracleHessian):
        model.factor, model.env_id = int(hessian), env
    budget = TASKS[env].budget
    returns = Returns(budget)
    model.learn(budget, callback=returns)
    return [returns.summary()]


def table(rows: pd.DataFrame) -> str:
    """Return a Markdown table of the mean returns, a row per task and target."""
    names = [name for name in HESSIANS if name in set(rows.hessian)]
    body = []
    for (env, kl), group in rows.groupby(["env", "target_kl"], sort=False):
        runs = {name: group[group.hessian == name].mean_return for name in names}
        cells = ["-" if run.empty else estimate(interval(run), ".0f") for run in runs.values()]
        body.append([env, f"{kl:g}", group.seed.nunique(), *cells])
    return markdown(["task", "target_kl", "seeds", *names], body)


def draw(rows: pd.DataFrame) -> Figure:
    """Draw the mean returns, a panel a task; print the table."""
    print(table(rows))
    figure, axes = plt.subplots(1, len(TASKS), figsize=(3 * len(TASKS), 3.2), layout="constrained")
    for axis, env in zip(axes, TASKS, strict=True):
        for colour, kl in zip(PALETTE, KLS, strict=False):
            _draw_means(axis, rows[(rows.env == env) & (rows.target_kl == kl)], colour)
        axis.tick_params(axis="x", labelrotation=45)
        axis.set_title(env, fontsize=9)
        axis.legend(fontsize=7)
    axes[0].set_ylabel("mean return over training")
    return figure


def _draw_means(axis: Axes, rows: pd.DataFrame, colour: str) -> None:
    means = rows.groupby("hessian").mean_return.mean().reindex(HESSIANS).dropna()
    axis.plot(means.index, means, "o", color=colour, label=f"target_kl {rows.target_kl.max():g}")
    axis.plot(rows.hessian, rows.mean_return, ".", ms=3, color=colour, alpha=0.4)


STUDY = Study("oracle", jobs, measure, draw, seeds=3)

if __name__ == "__main__":
    STUDY.main(str(__doc__))
