"""Errors of the estimates of ∇²J: trajectory against causal, baselines, and κ.

    python -m benchmarks.experiments.variance

Random MDPs with four states, seen as such, nearly deterministic transitions (Dirichlet(0.1)) and
rewards in [-1, 1]; γ = 0.99; θ drawn from the standard normal law. In the Frobenius norm, relative
to the exact Hessian:

- unbiased settings (κ = 1, full returns-to-go, visitation discounted, no normalisation): the mean
  squared error times the number of episodes, for several horizons, and with no baseline, the best
  V(s) fitted to other episodes, or the exact V_h(s);
- the causal estimator over κ, with the fitted baseline: bias² + variance/m for m episodes, the bias
  exact as well.
"""

from __future__ import annotations

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.common.figures import PALETTE
from benchmarks.common.intervals import interval
from benchmarks.common.markdown import estimate, markdown
from benchmarks.common.table import Row
from benchmarks.exact import TabularMDP, expected_causal_hessian, random_mdp
from benchmarks.experiments.learners import make_learner
from benchmarks.experiments.study import Study
from sb3_crpn import CRPN
from sb3_crpn.curvature import Causal, HessianEstimator, Trajectory
from sb3_crpn.curvature.derivatives import EpisodeDerivatives
from sb3_crpn.episodes import EpisodeBatch
from sb3_crpn.episodes.batch import episode_time

N_BATCHES, SIZE = 25, 50
HORIZONS = (2, 5, 10, 20, 50, 100)
BASELINES = {"none": "no baseline", "fitted": "fitted V(s)", "exact": "exact $V_h(s)$"}
ESTIMATORS = ("trajectory", "causal")
KAPPAS = (0.0, 0.25, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99)  # beside 1
KAPPA_HORIZON = 50
EPISODES = (10, 100, 1000, 10_000)


def jobs(seeds: int) -> list[Row]:
    """Return one job per MDP and horizon."""
    return [{"horizon": horizon, "seed": seed} for seed in range(seeds) for horizon in HORIZONS]


def measure(horizon: int, seed: int) -> list[Row]:
    """Return the errors of every estimator on one MDP, all from the same episodes."""
    mdp = random_mdp(seed, horizon=horizon, gamma=0.99, concentration=0.1)
    generator = torch.Generator().manual_seed(seed)
    theta = torch.randn(mdp.n_parameters, dtype=torch.float64, generator=generator)
    model = make_learner("CRPN, paper", mdp, SIZE, theta, seed)
    assert isinstance(model, CRPN)
    theta = model.actor.vector  # in the network's precision
    truth = mdp.hessian(theta)
    kinds: list[tuple[str, float, str]] = [
        (estimator, 1.0, baseline) for estimator in ESTIMATORS for baseline in BASELINES
    ]
    if horizon == KAPPA_HORIZON:
        kinds += [("causal", kappa, "fitted") for kappa in KAPPAS]
    fit, *batches = model.estimate_curvature(SIZE * (N_BATCHES + 1)).gradient_batch.split(
        N_BATCHES + 1
    )
    baselines = {
        "none": np.zeros((horizon, len(mdp.initial))),
        "fitted": np.tile(_mean_returns(mdp, fit), (horizon, 1)),
        "exact": mdp.values(theta).numpy(),
    }
    rows = []
    for estimator, kappa, baseline in kinds:
        weights = Causal(kappa) if estimator == "causal" else Trajectory()
        hessians = [
            _hessian(model, _less_baseline(mdp, batch, baselines[baseline]), weights)
            for batch in batches
        ]
        rows.append(
            {
                "estimator": estimator,
                "kappa": kappa,
                "baseline": baseline,
                "variance": SIZE * _variance(torch.stack(hessians)) / float((truth**2).sum()),
                "bias": _bias(mdp, theta, truth, kappa) if kappa < 1.0 else 0.0,
            }
        )
    return rows


def _mean_returns(mdp: TabularMDP, batch: EpisodeBatch) -> NDArray[np.float64]:
    """Return the mean return-to-go from each state, [S]."""
    states = _states(batch)
    returns = -batch.cost_advantages / mdp.gamma ** episode_time(batch.lengths)
    visits = np.bincount(states, minlength=len(mdp.initial))
    return np.bincount(states, returns, minlength=len(mdp.initial)) / np.maximum(visits, 1)


def _less_baseline(
    mdp: TabularMDP, batch: EpisodeBatch, values: NDArray[np.float64]
) -> EpisodeBatch:
    """Return the batch with the weights Ψ_i + γ^i V_i(s_i), ``values`` [H, S]."""
    time = episode_time(batch.lengths)
    baseline = mdp.gamma**time * values[time, _states(batch)]
    return replace(batch, cost_advantages=batch.cost_advantages + baseline)


def _states(batch: EpisodeBatch) -> NDArray[np.int64]:
    assert isinstance(batch.observations, torch.Tensor)
    return batch.observations.argmax(1).numpy()


def _hessian(model: CRPN, batch: EpisodeBatch, weights: HessianEstimator) -> torch.Tensor:
    """Return the estimate of ∇²J from one batch, [d, d]."""
    group = EpisodeDerivatives(model.policy, model.actor, batch, weights)
    identity = torch.eye(len(model.actor), dtype=torch.float64)
    return torch.stack([group.hessian_product(unit) for unit in identity])


def _variance(hessians: torch.Tensor) -> float:
    """Return E‖H - E H‖²_F from independent H [n, d, d]."""
    return float(hessians.var(0).sum())


def _bias(mdp: TabularMDP, theta: torch.Tensor, truth: torch.Tensor, kappa: float) -> float:
    """Return ‖E H - ∇²J‖_F / ‖∇²J‖_F of the causal estimator."""
    return float((expected_causal_hessian(mdp, theta, kappa) - truth).norm() / truth.norm())


def draw(rows: pd.DataFrame) -> Figure:
    """Draw the two panels and print the ratios."""
    unbiased = rows[rows.kappa == 1.0]
    body = []
    for horizon in HORIZONS:
        chosen = unbiased[unbiased.horizon == horizon]
        cells = [_ratio(chosen, ("trajectory", name), ("causal", name)) for name in BASELINES]
        cells += [_ratio(chosen, ("causal", "none"), ("causal", k)) for k in ("fitted", "exact")]
        cells.append(_ratio(chosen, ("trajectory", "none"), ("causal", "exact")))
        body.append([horizon, *cells])
    first, *others = BASELINES
    head = ["horizon", f"trajectory / causal: {first}", *others, "causal, none / fitted",
            "none / exact", "trajectory, none / causal, exact"]  # fmt: skip
    print(markdown(head, body))
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
    _draw_horizons(axes[0], unbiased)
    _draw_kappas(axes[1], rows[(rows.horizon == KAPPA_HORIZON) & (rows.estimator == "causal")])
    return figure


def _geometric(values: NDArray[np.float64]) -> float:
    """Return the geometric mean. The mean of ratios is then the ratio of means."""
    return float(np.exp(np.log(values).mean()))


def _ratio(rows: pd.DataFrame, first: tuple[str, str], second: tuple[str, str]) -> str:
    """Return the ratio of two (estimator, baseline)'s variances, MDP by MDP, and its interval."""
    variances = rows.pivot_table(index="seed", columns=["estimator", "baseline"], values="variance")
    ratios = interval(variances[first] / variances[second], statistic=_geometric)
    return estimate(ratios, ".2f")


def _draw_horizons(axis: Axes, rows: pd.DataFrame) -> None:
    for estimator, style in zip(ESTIMATORS, ("s--", "o-"), strict=True):
        for colour, (baseline, label) in zip(PALETTE, BASELINES.items(), strict=False):
            chosen = rows[(rows.estimator == estimator) & (rows.baseline == baseline)]
            bands = [
                interval(group.variance, statistic=_geometric)
                for _, group in chosen.groupby("horizon")
            ]
            middle, low, high = np.array(bands).T
            axis.plot(HORIZONS, middle, style, ms=4, color=colour, label=f"{estimator}, {label}")
            axis.fill_between(HORIZONS, low, high, color=colour, alpha=0.15, lw=0)
    axis.set(xscale="log", yscale="log", xlabel="horizon, steps")
    axis.set_xticks(HORIZONS, HORIZONS)
    axis.minorticks_off()
    axis.set_ylabel(r"error per episode, $m\,\mathrm{E}\|H-\nabla^2J\|_F^2\,/\,\|\nabla^2J\|_F^2$")
    axis.legend(fontsize=7)
    axis.set_title("unbiased estimators", fontsize=9)


def _draw_kappas(axis: Axes, rows: pd.DataFrame) -> None:
    rows = rows[rows.baseline == "fitted"]
    kappas = np.array([*KAPPAS, 1.0])
    x = np.arange(len(kappas))
    for colour, m in zip(PALETTE, EPISODES, strict=False):
        totals = rows.assign(total=rows.bias**2 + rows.variance / m)
        bands = [
            interval(group.total, statistic=_geometric) for _, group in totals.groupby("kappa")
        ]
        middle, low, high = np.array(bands).T
        best, gain = kappas[middle.argmin()], middle.min() / middle[-1]
        print(f"m = {m}: best κ = {best:g}, error {gain:.2f} of that of κ = 1")
        axis.plot(x, middle, "o-", ms=4, color=colour, label=f"m = {m} episodes")
        axis.fill_between(x, low, high, color=colour, alpha=0.15, lw=0)
        axis.plot(x[middle.argmin()], middle.min(), "*", ms=11, color=colour)
    axis.set_xticks(x, [f"{kappa:g}" for kappa in kappas])
    axis.set(yscale="log", xlabel="κ")
    axis.set_ylabel(r"bias² + variance/$m$, relative to $\|\nabla^2J\|_F^2$")
    axis.legend(fontsize=7)
    axis.set_title(f"causal estimator, horizon {KAPPA_HORIZON}, fitted V(s)", fontsize=9)


STUDY = Study("variance", jobs, measure, draw, seeds=12)

if __name__ == "__main__":
    STUDY.main(str(__doc__))
