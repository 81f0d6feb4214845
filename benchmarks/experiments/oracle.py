"""The value of the Hessian in training, and of a better estimate of it.

    python -m benchmarks.experiments.oracle

Training with an environment's entry at a ``target_kl`` of 0.02, or at four times it, where a
second order should matter more. The Hessian of each update is

- ``none``: left out; ``own``: from the update's episodes, earlier rollouts included, as CRPN does;
- ``fresh``: from the fresh rollout alone;
- ``confirmed``: shrunk, and with earlier rollouts or without, by the value on held-out episodes;
- ``1`` … ``16``: from as many times the rollout's episodes, fresh and independent, which are not
  counted as training: an oracle.

Mean return over training, the CSV also has that of the last fifth.
"""

from __future__ import annotations

import itertools
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.common.figures import PALETTE
from benchmarks.common.intervals import interval
from benchmarks.common.markdown import estimate, markdown
from benchmarks.common.table import Row
from benchmarks.experiments.hessians import ConfirmedHessian, FreshHessian, OracleHessian
from benchmarks.experiments.study import Study
from benchmarks.experiments.tasks import Returns, make_model
from sb3_crpn import CRPN

BUDGETS = {"CartPole-v1": 20_000, "Pendulum-v1": 30_000}
KLS = (0.02, 0.08)
FACTORS = (1, 2, 4, 8, 16)
HESSIANS = ("none", "own", "fresh", "confirmed", *map(str, FACTORS))


def jobs(seeds: int) -> list[Row]:
    """Return one job per training run."""
    return [
        {"env": env, "target_kl": kl, "hessian": hessian, "seed": seed}
        for seed, hessian, kl, env in itertools.product(range(seeds), HESSIANS, KLS, BUDGETS)
    ]


def measure(env: str, target_kl: float, hessian: str, seed: int) -> list[Row]:
    """Train once."""
    algorithms: dict[str, type[CRPN]] = {"fresh": FreshHessian, "confirmed": ConfirmedHessian}
    algorithm, arguments = algorithms.get(hessian, CRPN), dict[str, Any](target_kl=target_kl)
    if hessian == "none":
        arguments["hessian_shrinkage"] = 0.0
    elif hessian.isdecimal():
        algorithm = OracleHessian
    model = make_model(env, seed, algorithm, **arguments)
    if isinstance(model, OracleHessian):
        model.factor, model.env_id = int(hessian), env
    returns = Returns(BUDGETS[env])
    model.learn(BUDGETS[env], callback=returns)
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
    figure, axes = plt.subplots(1, len(BUDGETS), figsize=(9, 3.4), layout="constrained")
    for axis, env in zip(axes, BUDGETS, strict=True):
        _draw_means(axis, rows[rows.env == env])
        axis.set_title(env, fontsize=9)
    axes[0].set_ylabel("mean return over training")
    axes[0].legend()
    return figure


def _draw_means(axis: Axes, rows: pd.DataFrame) -> None:
    x = np.arange(len(HESSIANS))
    for shift, colour, kl in zip((-0.12, 0.12), PALETTE, KLS, strict=False):
        for position, name in zip(x + shift, HESSIANS, strict=True):
            values = rows[(rows.target_kl == kl) & (rows.hessian == name)].mean_return
            if values.empty:
                continue
            mean, low, high = interval(values)
            label = f"target_kl {kl:g}" if name == HESSIANS[0] else None
            axis.errorbar(
                position, mean, [[mean - low], [high - mean]], fmt="o", color=colour, label=label
            )
            axis.plot(np.full(len(values), position), values, ".", ms=3, color=colour, alpha=0.4)
    axis.set_xticks(x, HESSIANS)
    axis.set_xlabel("Hessian from")


STUDY = Study("oracle", jobs, measure, draw, seeds=5)

if __name__ == "__main__":
    STUDY.main(str(__doc__))
