"""Training with earlier rollouts weighted by regression of the fresh gradient on theirs.

    python -m benchmarks.experiments.stacked

With g_0 the fresh gradient and g_a that of the a-th newest earlier rollout, a = 1 … n, both means
over steps, the weights are those of stacked regression (Breiman, Machine Learning 1996),

    w = argmin_{w ≥ 0} E‖Σ_a w_a g_a - ∇J‖²,    G w = c where w > 0,

G_ab = E⟨g_a, g_b⟩ and c_a = E⟨g_a, ∇J⟩. ∇J is known by g_0, whose noise is independent of g_a for
a ≥ 1; c_0 is the product of two halves of the fresh rollout. Expectations are exponential means
over the updates before, each divided by its ‖g_0‖², and norms those of (F + εI)^-1. Cost advantages
are scaled so that g and H have the weights. Seeds from 10 on, which no table of the benchmark
reports.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.optimize import nnls

from benchmarks.common.figures import PALETTE
from benchmarks.common.intervals import interval
from benchmarks.common.markdown import estimate, markdown
from benchmarks.common.table import Row
from benchmarks.experiments.steps import fisher_subspace, gradient_sums, n_steps
from benchmarks.experiments.study import Study
from benchmarks.experiments.tasks import Returns, make_model
from sb3_crpn import CRPN
from sb3_crpn.algorithm.update import UpdateData
from sb3_crpn.arrays import FloatArray
from sb3_crpn.curvature import HESSIAN_ESTIMATORS, CurvatureEstimate
from sb3_crpn.curvature.derivatives import EpisodeDerivatives
from sb3_crpn.episodes import EpisodeBatch

BUDGETS = {"CartPole-v1": 30_000, "Acrobot-v1": 40_000, "Pendulum-v1": 40_000}
FIRST_SEED = 10
SIZES = (3, 6, 8)
ARMS = ("equal", "stacked")
MEMORY = 0.9  # by which the means of the past fade in an update
MIN_UPDATES = 5  # half of the memory 1/(1 - 0.9): before them a rollout is weighted as by CRPN
FLOOR = 1e-3  # of G's eigenvalues, relative to the largest: entries are means of different updates
DIM = 5  # of the Krylov spaces that solve for (F + εI)^-1 g: more change products by < 0.1 %
N_LAST = 10  # updates whose weights are reported


class ProductMeans:
    """Exponential means of G and c; of the first updates, plain means.

    Parameters
    ----------
    size
        n.
    """

    def __init__(self, size: int) -> None:
        self._gram = np.zeros((size + 1, size + 1))
        self._target = np.zeros(size + 1)
        self._n_updates = np.zeros(size + 1, dtype=np.int64)

    def update(self, gram: FloatArray, target: FloatArray) -> None:
        """Add the G, [k, k], and c, [k], of an update of k ≤ n + 1 rollouts."""
        k = len(target)
        self._n_updates[:k] += 1
        rates = np.maximum(1.0 - MEMORY, 1.0 / self._n_updates[:k])
        # an entry is as old as the older of its two rollouts
        self._gram[:k, :k] += np.maximum.outer(rates, rates) * (gram - self._gram[:k, :k])
        self._target[:k] += rates * (target - self._target[:k])

    def weights(self, k: int) -> FloatArray:
        """Return w of the first k rollouts, or of fewer that have been seen often enough."""
        k = min(k, int((self._n_updates >= MIN_UPDATES).sum()))
        return regression_weights(self._gram[:k, :k], self._target[:k])


def regression_weights(gram: FloatArray, target: FloatArray) -> FloatArray:
    """Return argmin_{w ≥ 0} wᵀGw - 2c·w, G made positive definite."""
    if not len(gram):
        return target
    eigenvalues, vectors = np.linalg.eigh(gram)
    roots = np.sqrt(np.maximum(eigenvalues, FLOOR * eigenvalues[-1]))
    weights: FloatArray = nnls(roots[:, None] * vectors.T, vectors.T @ target / roots)[0]
    return weights


def step_factors(weights: FloatArray, sizes: Sequence[int]) -> FloatArray:
    """Return by what to multiply the cost advantages of rollouts of ``sizes`` steps.

    The first rollouts get the ``weights``. The mean factor of a step is 1, among them and among
    the others, whose factors are 1, as are all if every weight is 0.
    """
    factors, first = np.ones(len(sizes)), np.array(sizes[: len(weights)])
    if weights.any():
        factors[: len(weights)] = weights / weights.sum() * (first.sum() / first)
    return factors


class StackedCRPN(CRPN):
    """CRPN whose rollouts are weighted by regression.

    Attributes
    ----------
    stacked
        Whether they are, or all factors are 1.
    shares
        Of each update: every rollout's share of the weights, the fresh one first.
    """

    stacked = True

    def _setup_model(self) -> None:
        super()._setup_model()
        self.shares: list[FloatArray] = []
        self._means = ProductMeans(self.n_reused_rollouts)

    def _estimate(self, data: UpdateData) -> CurvatureEstimate:
        batches = [data.fresh, *reversed(data.earlier)]  # the newest first
        sizes = [batch.n_steps for batch in batches]
        factors = np.ones(len(batches))
        if self.stacked:
            # of the updates before: the noise of this one does not choose its own weights
            factors = step_factors(self._means.weights(len(batches)), sizes)
            self._observe(batches)
        self.shares.append(factors * sizes / np.sum(sizes))
        fresh, *earlier = map(_scale, batches, factors)
        return super()._estimate(UpdateData(fresh, earlier[::-1]))

    def _observe(self, batches: list[EpisodeBatch]) -> None:
        """Add the gradients' products, unless the fresh rollout has no halves or no gradient."""
        estimator = HESSIAN_ESTIMATORS.resolve(self.hessian_estimator, self)
        parts = batches[0].split(2) + batches[1:]
        groups = [EpisodeDerivatives(self.policy, self.actor, part, estimator) for part in parts]
        sizes = n_steps(groups)
        gradients = gradient_sums(groups) / sizes[:, None]
        if len(parts) == len(batches) or not gradients[:2].any():
            return
        duals = []
        for gradient in gradients:
            space = fisher_subspace(groups[:2], gradient, self.fisher_damping, DIM)
            duals.append(space.basis @ (space.basis.T @ gradient))
        products = (gradients @ torch.stack(duals).T).numpy()
        self._means.update(*joined_products(0.5 * (products + products.T), sizes[:2].numpy()))


def joined_products(products: FloatArray, sizes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return G and c, divided by ‖g_0‖², from the products of the halves' and all other gradients.

    g_0 is the mean of the halves' gradients, weighted by ``sizes``.
    """
    join = np.zeros((len(products) - 1, len(products)))
    join[0, :2] = sizes / sizes.sum()
    join[1:, 2:] = np.eye(len(products) - 2)
    gram = join @ products @ join.T
    target = gram[0].copy()
    target[0] = products[0, 1]
    return gram / gram[0, 0], target / gram[0, 0]


def _scale(batch: EpisodeBatch, factor: float) -> EpisodeBatch:
    return replace(batch, cost_advantages=factor * batch.cost_advantages)


def jobs(seeds: int) -> list[Row]:
    """Return one job per training run."""
    cases = itertools.product(range(FIRST_SEED, FIRST_SEED + seeds), BUDGETS, SIZES, ARMS)
    return [
        {"env": env, "n_reused_rollouts": size, "arm": arm, "seed": seed}
        for seed, env, size, arm in cases
    ]


def measure(env: str, n_reused_rollouts: int, arm: str, seed: int) -> list[Row]:
    """Train once. ``shares`` are by age, means over the last updates."""
    model = make_model(env, seed, StackedCRPN, n_reused_rollouts=n_reused_rollouts)
    assert isinstance(model, StackedCRPN)
    model.stacked = arm == "stacked"
    returns = Returns(BUDGETS[env])
    model.learn(BUDGETS[env], callback=returns)
    shares = np.zeros((len(model.shares), n_reused_rollouts + 1))
    for row, found in zip(shares, model.shares, strict=True):
        row[: len(found)] = found
    n_reused = np.mean([len(found) - 1 for found in model.shares])
    last = {"mean_reused": float(n_reused), "shares": shares[-N_LAST:].mean(0).tolist()}
    return [returns.summary() | last]


def table(rows: pd.DataFrame) -> str:
    """Return a Markdown table: a row per task and number of rollouts; differences are by seed."""
    body = []
    for (env, size), group in rows.groupby(["env", "n_reused_rollouts"], sort=False):
        cells = []
        for column in ("mean_return", "late_return"):
            runs = group.pivot_table(index="seed", columns="arm", values=column).dropna()
            means = [estimate(interval(runs[arm]), ".0f") for arm in ARMS]
            cells += [*means, estimate(interval(runs.stacked - runs.equal), "+.0f")]
        body.append([env, size, len(runs), *cells])
    late = [f"last fifth: {name}" for name in (*ARMS, "difference")]
    return markdown(["task", "reused", "seeds", *ARMS, "difference", *late], body)


def shares_table(rows: pd.DataFrame) -> str:
    """Return a Markdown table of the shares of the weights, means over seeds.

    With k equal shares their effective number 1/Σ share² is k.
    """
    body = []
    for (env, size, arm), group in rows.groupby(["env", "n_reused_rollouts", "arm"], sort=False):
        shares = _shares(group)
        effective = (1.0 / (shares**2).sum(1)).mean()
        means = " ".join(f"{share:.2f}" for share in shares.mean(0))
        body.append([env, size, arm, f"{group.mean_reused.mean():.1f}", f"{effective:.1f}", means])
    return markdown(["task", "reused", "weights", "in use", "effective", "shares by age"], body)


def _shares(rows: pd.DataFrame) -> FloatArray:
    shares: FloatArray = np.array([json.loads(text) for text in rows.shares])
    return shares


def draw(rows: pd.DataFrame) -> Figure:
    """Draw mean returns, and shares of the weights by age; print the tables."""
    print(table(rows), shares_table(rows), sep="\n\n")
    figure, axes = plt.subplots(2, len(BUDGETS), figsize=(9, 5), layout="constrained")
    for env, above, below in zip(BUDGETS, *axes, strict=True):
        for shift, (colour, arm) in enumerate(zip(PALETTE, ARMS, strict=False)):
            chosen = rows[(rows.env == env) & (rows.arm == arm)]
            _draw_returns(above, chosen, 0.1 * (2 * shift - 1), colour)
            largest = chosen[chosen.n_reused_rollouts == max(SIZES)]
            if not largest.empty:
                below.plot(_shares(largest).mean(0), "o-", ms=4, color=colour, label=arm)
        above.set_title(env, fontsize=9)
        above.set_xlabel("n_reused_rollouts")
        below.set_xlabel(f"age of the rollout, of {max(SIZES)} reused ones")
    axes[1, 0].legend(title="weights")
    axes[0, 0].set_ylabel("mean return over training")
    axes[1, 0].set_ylabel("share of the weights at the end")
    return figure


def _draw_returns(axis: Axes, rows: pd.DataFrame, shift: float, colour: str) -> None:
    for size, group in rows.groupby("n_reused_rollouts"):
        mean, low, high = interval(group.mean_return)
        axis.errorbar(
            size + shift, mean, [[mean - low], [high - mean]],
            fmt="o", ms=4, color=colour,
        )  # fmt: skip
    axis.set_xticks(SIZES)


STUDY = Study("stacked", jobs, measure, draw, seeds=3)

if __name__ == "__main__":
    STUDY.main(str(__doc__))
