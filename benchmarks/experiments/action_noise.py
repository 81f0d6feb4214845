"""A trust region of its own for the noise of the actions.

    python -m benchmarks.experiments.action_noise

In the metric M = F + εI a change δ of a Gaussian policy's log σ weighs 2/k ‖δ‖², k the number of
action components. Here it weighs c times as much, so that steps of the same KL divergence change σ
less and the mean more. Each environment's entry, with reused rollouts and without; seeds from 10
on, which no table of the benchmark reports.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import matplotlib.pyplot as plt
import pandas as pd
import torch
from matplotlib.figure import Figure

from benchmarks.common.figures import PALETTE
from benchmarks.common.intervals import interval
from benchmarks.common.markdown import estimate, markdown
from benchmarks.common.table import Row
from benchmarks.experiments.study import Study
from benchmarks.experiments.tasks import Returns, make_model
from sb3_crpn import CRPN
from sb3_crpn.algorithm.update import UpdateData
from sb3_crpn.curvature import CurvatureEstimate, GroupedOperator

BUDGET = 100_000
FIRST_SEED = 10
WEIGHTS = (1.0, 8.0)
# Environments and their reused rollouts: the entries', then those that the entries go without
CASES = (
    ("Hopper-v5", 0),
    ("Swimmer-v5", 0),
    ("HalfCheetah-v5", 3),
    ("Walker2d-v5", 0),
    ("Hopper-v5", 3),
    ("Swimmer-v5", 3),
)


class WeightedNoise(CRPN):
    """CRPN whose metric weighs changes of log σ ``weight`` times as much.

    Attributes
    ----------
    weight
        c > 0 of the module's docstring.
    """

    weight: float = 1.0

    def _estimate(self, data: UpdateData) -> CurvatureEstimate:
        found = super()._estimate(data)
        log_std = self.policy.log_std
        flags = [torch.full_like(t, float(t is log_std)) for t in self.actor.tensors]
        extra = 2.0 * (self.weight - 1.0) / log_std.numel() * self.actor.flatten(flags)
        return replace(found, fisher=plus_diagonal(found.fisher, extra))


def plus_diagonal(operator: GroupedOperator, diagonal: torch.Tensor) -> GroupedOperator:
    """Return B + diag(d) for B known by products, d [size]."""

    def products(vector: torch.Tensor) -> torch.Tensor:
        return operator._group_products(vector) + diagonal * vector

    return GroupedOperator(len(diagonal), products, operator.weights, total=operator._total)


def jobs(seeds: int) -> list[Row]:
    """Return one job per training run."""
    cases = itertools.product(range(FIRST_SEED, FIRST_SEED + seeds), CASES, WEIGHTS)
    return [
        {"env": env, "n_reused_rollouts": n, "weight": weight, "seed": seed}
        for seed, (env, n), weight in cases
    ]


def measure(env: str, n_reused_rollouts: int, weight: float, seed: int) -> list[Row]:
    """Train once."""
    model = make_model(env, seed, WeightedNoise, n_reused_rollouts=n_reused_rollouts)
    assert isinstance(model, WeightedNoise)
    model.weight = weight
    returns = Returns(BUDGET)
    model.learn(BUDGET, callback=returns)
    return [{**returns.summary(), "std": float(model.policy.log_std.exp().mean())}]


def table(rows: pd.DataFrame) -> str:
    """Return a Markdown table, a row per task, reuse and weight."""
    body = []
    for (env, n, weight), runs in rows.groupby(["env", "n_reused_rollouts", "weight"], sort=False):
        means = [estimate(interval(runs[name]), ".0f") for name in ("mean_return", "late_return")]
        body.append([env, n, f"{weight:g}", len(runs), *means, f"{runs['std'].median():.2f}"])
    head = ["task", "reused rollouts", "c", "seeds", "mean return over training", "last fifth", "σ"]
    return markdown(head, body)


def draw(rows: pd.DataFrame) -> Figure:
    """Draw the mean returns against c, a panel a case; print the table."""
    print(table(rows))
    figure, axes = plt.subplots(2, 3, figsize=(9, 5), layout="constrained")
    for axis, (env, n) in zip(axes.flat, CASES, strict=True):
        runs = rows[(rows.env == env) & (rows.n_reused_rollouts == n)]
        for _, run in runs.groupby("seed"):
            axis.plot(run.weight, run.mean_return, ".-", color=PALETTE[0], alpha=0.3)
        means = runs.groupby("weight").mean_return.mean()
        axis.plot(means.index, means, "o-", color=PALETTE[0])
        axis.set(xscale="log", xlabel="c")
        axis.set_title(f"{env}, {n} reused rollouts", fontsize=9)
    axes[0, 0].set_ylabel("mean return over training")
    return figure


STUDY = Study("action_noise", jobs, measure, draw, seeds=2)

if __name__ == "__main__":
    STUDY.main(str(__doc__))
