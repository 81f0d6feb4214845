"""The damping ε of the Fisher metric, fixed or chosen by held-out episodes.

    python -m benchmarks.experiments.damping

Each environment's entry with several ε, and with the ε whose first-order steps other episodes of
the same rollout like best: the value of an ε is the mean over folds of -(g·s + ½ sᵀHs), g and H the
fold's, s the natural-gradient step of all other episodes with the KL divergence ``target_kl``; and
over updates, the past fading by a factor of 0.9. Seeds from 10 on, which no table of the benchmark
reports.
"""

from __future__ import annotations

import itertools

import matplotlib.pyplot as plt
import pandas as pd
import torch
from matplotlib.figure import Figure

from benchmarks.common.figures import PALETTE
from benchmarks.common.intervals import interval
from benchmarks.common.markdown import estimate, markdown
from benchmarks.common.table import Row
from benchmarks.experiments.crossfit import CrossFit, Fold
from benchmarks.experiments.hessians import remember, step_value
from benchmarks.experiments.steps import step_of_kl
from benchmarks.experiments.study import Study
from benchmarks.experiments.tasks import Returns, make_model
from sb3_crpn import CRPN
from sb3_crpn.algorithm.update import UpdateData
from sb3_crpn.curvature import CurvatureEstimate

BUDGETS = {
    "CartPole-v1": 20_000,
    "Acrobot-v1": 30_000,
    "Pendulum-v1": 30_000,
}
DAMPINGS = (0.03, 0.1, 0.3, 1.0, 3.0)
ARMS = ("0.1", "1", "3", "chosen")
FIRST_SEED = 10


class ChosenDamping(CRPN):
    """ε chosen by the value of first-order steps on held-out episodes.

    Attributes
    ----------
    values
        The mean values so far, by ε.
    """

    def _setup_model(self) -> None:
        self.values: dict[float, float] = {}
        super()._setup_model()

    def _estimate(self, data: UpdateData) -> CurvatureEstimate:
        if data.fresh.n_episodes > 1:
            self._judge(CrossFit(self, data.fresh, data.earlier))
            self.fisher_damping = max(self.values, key=self.values.__getitem__)
        return super()._estimate(data)

    def _judge(self, folds: CrossFit) -> None:
        """Update the exponentially weighted means with this rollout's values."""
        total = dict.fromkeys(DAMPINGS, 0.0)
        for fold in folds:
            for damping, value in self._fold_values(folds, fold).items():
                total[damping] += fold.weight * value
        remember(self.values, total)

    def _fold_values(self, folds: CrossFit, fold: Fold) -> dict[float, float]:
        assert self.target_kl is not None
        test = folds.hessian_forms(fold)[fold.index] / folds.sizes[fold.index]
        values = {}
        for damping in DAMPINGS:
            space, factors = fold.space.redamped(self.fisher_damping, damping)
            gradient = factors * fold.gradient
            y = step_of_kl(gradient, torch.zeros_like(test), space, self.target_kl)
            values[damping] = step_value(
                factors * fold.test_gradient, torch.outer(factors, factors) * test, y
            )
        return values


def jobs(seeds: int) -> list[Row]:
    """Return one job per training run."""
    cases = itertools.product(range(FIRST_SEED, FIRST_SEED + seeds), BUDGETS, ARMS)
    return [{"env": env, "damping": arm, "seed": seed} for seed, env, arm in cases]


def measure(env: str, damping: str, seed: int) -> list[Row]:
    """Train once."""
    if damping == "chosen":
        model = make_model(env, seed, ChosenDamping)
    else:
        model = make_model(env, seed, fisher_damping=float(damping))
    returns = Returns(BUDGETS[env])
    model.learn(BUDGETS[env], callback=returns)
    return [{**returns.summary(), "last_damping": model.fisher_damping}]


def table(rows: pd.DataFrame) -> str:
    """Return a Markdown table of the mean returns, a row per task."""
    body = []
    for env, group in rows.groupby("env", sort=False):
        arms = {arm: group[group.damping == arm] for arm in ARMS}
        cells = [estimate(interval(runs.mean_return), ".0f") for runs in arms.values()]
        chosen = ", ".join(f"{value:g}" for value in arms["chosen"].last_damping)
        body.append([env, group.seed.nunique(), *cells, chosen])
    return markdown(["task", "seeds", *(f"ε = {a}" for a in ARMS[:-1]), "chosen", "last ε"], body)


def draw(rows: pd.DataFrame) -> Figure:
    """Draw the mean returns, a panel a task; print the table."""
    print(table(rows))
    size = (2.4 * len(BUDGETS), 2.8)
    figure, axes = plt.subplots(1, len(BUDGETS), figsize=size, layout="constrained")
    for axis, env in zip(axes, BUDGETS, strict=True):
        runs = rows[rows.env == env]
        means = runs.groupby("damping").mean_return.mean().reindex(ARMS)
        axis.plot(means.index, means, "o", color=PALETTE[0])
        axis.plot(runs.damping, runs.mean_return, ".", ms=3, color=PALETTE[0], alpha=0.4)
        axis.set(xlabel="ε")
        axis.set_title(env, fontsize=9)
    axes[0].set_ylabel("mean return over training")
    return figure


STUDY = Study("damping", jobs, measure, draw, seeds=3)

if __name__ == "__main__":
    STUDY.main(str(__doc__))
