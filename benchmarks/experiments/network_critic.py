"""A critic for the cross-time terms of H with a network's features: the error of H in training.

    python -m benchmarks.experiments.network_critic

Training with an environment's entry stops early in learning. Batches of fresh episodes of that
policy, as many as an update has with its reused rollouts, estimate H on a Krylov space K(F, g) of
further episodes, in coordinates where F + εI is I. Estimates are

- without a critic, fit = 0: CRPN's, with several κ;
- with the critic of :mod:`~benchmarks.experiments.critic_hessian`, κ = 0.9, fitted to 1, 3 or 6
  other batches.

Errors are those of one batch's H_i from R = E R_i, the expectation of CRPN's R_i with κ = 0.9, not
from ∇²J. R is known by other batches alone. Every product of expectations is a mean over pairs of
batches that share no episodes, those of the critic included, so that their noise adds nothing:

    ‖R‖² = mean ⟨R_i, R_j⟩ over i ≠ j,  ⟨E H, R⟩ = mean ⟨H_i, R_j⟩ over j ∉ S_i,
    ‖E H - R‖² = mean ⟨H_i - R_i, H_j - R_j⟩ over S_i ∩ S_j = ∅,

S_i the batch i and those of its critic. Then E‖H_i - R‖² = mean ‖H_i‖² - 2⟨E H, R⟩ + ‖R‖². In
expectation this is the mean of ‖H_i - R̄_i‖², R̄_i the mean of the batches not in S_i, less the
noise of R̄_i.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.common.figures import PALETTE
from benchmarks.common.markdown import markdown
from benchmarks.common.table import Row
from benchmarks.experiments.critic_hessian import ProjectedSteps, ScoredEpisodes, fit_critic
from benchmarks.experiments.steps import fisher_subspace, gradient_sums, n_steps
from benchmarks.experiments.study import Study
from benchmarks.experiments.tasks import Returns, make_model
from sb3_crpn import CRPN
from sb3_crpn.arrays import BoolArray, FloatArray
from sb3_crpn.curvature import Causal
from sb3_crpn.curvature.derivatives import EpisodeDerivatives

KAPPA = 0.9  # of R, and of the critic: CRPN's default
KAPPAS = (0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 1.0)
TRACES = (0.0, 0.5)  # λ_H
FITS = (1, 3, 6)  # batches of the critic
N_BATCHES = 24
N_SPACE = 6  # batches that make the Krylov space
DIM = 10  # of it, CRPN's default
FIRST_SEED = 10
ERRORS = ("error", "scaled")  # of H, and of the best ωH


class Task(NamedTuple):
    """The timesteps of a checkpoint, the episodes of a batch, and the number of checkpoints."""

    timesteps: int
    episodes: int
    seeds: int = 2


TASKS = {
    "CartPole-v1": Task(7_700, 10),
    "Pendulum-v1": Task(15_600, 16),
    "HalfCheetah-v5": Task(40_000, 8, seeds=1),
}


def jobs(seeds: int) -> list[Row]:
    """Return one job per checkpoint."""
    cases = product(range(seeds), TASKS.items())
    return [{"env": env, "seed": FIRST_SEED + k} for k, (env, task) in cases if k < task.seeds]


def measure(env: str, seed: int) -> list[Row]:
    """Train to the checkpoint and return the error of every estimate there."""
    task = TASKS[env]
    model = make_model(env, seed)
    model.learn(task.timesteps, callback=Returns(task.timesteps))
    return [{"episodes": task.episodes} | row for row in errors(project(model, task.episodes))]


def project(model: CRPN, per_batch: int) -> list[ProjectedSteps]:
    """Return batches of new episodes in the coordinates of K(F, g) of others.

    Advantages are normalised batch by batch, as in training rollout by rollout.
    """
    n = N_SPACE + N_BATCHES
    batches = [model.estimate_curvature(per_batch).gradient_batch for _ in range(n)]
    model.policy.set_training_mode(False)
    weights = Causal(KAPPA)  # of H, which is not asked for
    groups = [
        EpisodeDerivatives(model.policy, model.actor, batch, weights) for batch in batches[:N_SPACE]
    ]
    gradient = gradient_sums(groups).sum(0) / n_steps(groups).sum()
    basis = fisher_subspace(groups, gradient, model.fisher_damping, DIM).basis
    return [
        ScoredEpisodes(model.policy, model.actor, batch).project(basis)
        for batch in batches[N_SPACE:]
    ]


def errors(batches: list[ProjectedSteps]) -> list[Row]:
    """Return the moments of every estimate."""
    plain = {kappa: _forms(batches, kappa, 1.0, 0) for kappa in KAPPAS}
    rows = []
    for kappa, forms in plain.items():
        setting = {"fit": 0, "kappa": kappa, "trace": 1.0}
        rows.append(setting | moments(forms, plain[KAPPA], 0))
    for fit, trace in product(FITS, TRACES):
        forms = _forms(batches, KAPPA, trace, fit)
        setting = {"fit": fit, "kappa": KAPPA, "trace": trace}
        rows.append(setting | moments(forms, plain[KAPPA], fit))
    return rows


def _forms(batches: list[ProjectedSteps], kappa: float, trace: float, fit: int) -> FloatArray:
    """Return each batch's H, a mean over steps, as a vector, [K, n²]."""
    forms = []
    for batch, used in zip(batches, uses(len(batches), fit), strict=True):
        others = [batches[j] for j in np.flatnonzero(used) if batches[j] is not batch]
        critic = fit_critic(others, kappa) if others else None
        forms.append(batch.form(kappa, trace, critic).numpy() / batch.lengths.sum())
    return np.array(forms).reshape(len(batches), -1)


def uses(n: int, fit: int) -> BoolArray:
    """Return whether the estimate i uses batch j: i, and the ``fit`` batches after it, [n, n]."""
    ahead = (np.arange(n) - np.arange(n)[:, None]) % n
    used: BoolArray = ahead <= fit
    return used


def moments(estimates: FloatArray, references: FloatArray, fit: int) -> dict[str, float]:
    """Return the moments of H relative to ‖R‖², of estimates H_i and references R_i, [K, n²].

    ``square`` is E‖H_i‖², ``mean_square`` ‖E H‖², ``slope`` ⟨E H, R⟩/‖R‖².
    """
    used, own = uses(len(estimates), fit), uses(len(estimates), 0)
    signal = _inner(references, references, own, own)
    deviations = estimates - references
    squared_bias = _inner(deviations, deviations, used, used)
    return {
        "square": float((estimates**2).sum(1).mean()) / signal,
        "mean_square": _inner(estimates, estimates, used, used) / signal,
        "slope": _inner(estimates, references, used, own) / signal,
        "bias": (max(squared_bias, 0.0) / signal) ** 0.5,
    }


def _inner(left: FloatArray, right: FloatArray, first: BoolArray, second: BoolArray) -> float:
    """Return ⟨E x, E y⟩, the mean of ⟨x_i, y_j⟩ over pairs that use no batch in common."""
    apart = ~(first @ second.T)
    return float((left @ right.T)[apart].mean())


def with_errors(rows: pd.DataFrame, more: int = 1) -> pd.DataFrame:
    """Return the rows with the error of H from ``more`` times the episodes, and of the best ωH.

    Relative to ‖R‖²: e = q - 2p + 1, and 1 - p²/q at ω = p/q, where q = E‖H‖² and p is the slope.
    """
    square = rows.mean_square + (rows.square - rows.mean_square) / more
    error, scaled = square - 2.0 * rows.slope + 1.0, 1.0 - rows.slope**2 / square
    return rows.assign(error=error, omega=rows.slope / square, scaled=scaled)


def settings_table(rows: pd.DataFrame) -> str:
    """Return a Markdown table: error of H, of the best ωH, and bias, a column a checkpoint."""
    found = _by_checkpoint(with_errors(rows))
    body = []
    for (fit, kappa, trace), group in found.groupby(["fit", "kappa", "trace"]):
        cells = group.set_index("checkpoint").reindex(found.checkpoint.unique())
        texts = [f"{cell.error:.2f}; {cell.scaled:.2f}; {cell.bias:.2f}" for cell in cells.iloc]
        critic = [f"{fit} ×", f"{trace:g}"] if fit else ["none", "-"]
        body.append([critic[0], f"{kappa:g}", critic[1], *texts])
    return markdown(["critic", "κ", "λ_H", *found.checkpoint.unique()], body)


def best_table(rows: pd.DataFrame) -> str:
    """Return a Markdown table: the lowest errors of H and of ωH, by who has the critic's episodes.

    Without a critic H has them.
    """
    body = []
    for checkpoint, group in _by_checkpoint(rows).groupby("checkpoint", sort=False):
        plain = group[group.fit == 0]
        cells = [_best(with_errors(plain, more), "kappa") for more in (1, *(1 + k for k in FITS))]
        cells += [_best(with_errors(group[group.fit == fit]), "trace") for fit in FITS]
        body.append([checkpoint, *cells])
    multiples = (f"best κ, {1 + fit} × episodes" for fit in FITS)
    critics = (f"critic, {fit} ×" for fit in FITS)
    return markdown(["checkpoint", "best κ", *multiples, *critics], body)


def _by_checkpoint(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with their checkpoint's name, in the order of ``TASKS``."""
    named = rows.assign(checkpoint=rows.env + ", " + rows.seed.astype(str))
    order = [named[named.env == env].sort_values("seed", kind="stable") for env in TASKS]
    return pd.concat(order)


def _best(rows: pd.DataFrame, setting: str) -> str:
    """Return the lowest of both errors, and their κ or λ_H."""
    found = rows.set_index(setting)
    lowest = (f"{found[column].min():.2f} ({found[column].idxmin():g})" for column in ERRORS)
    return "; ".join(lowest)


def draw(rows: pd.DataFrame) -> Figure:
    """Draw the errors, a panel a checkpoint; print the tables."""
    print(settings_table(rows), best_table(rows), sep="\n\n")
    groups = list(_by_checkpoint(with_errors(rows)).groupby("checkpoint", sort=False))
    size = (2.3 * len(groups), 3.2)
    figure, axes = plt.subplots(1, len(groups), figsize=size, layout="constrained", squeeze=False)
    for axis, (checkpoint, group) in zip(axes[0], groups, strict=True):
        _draw(axis, group)
        axis.set(xlabel=r"$\kappa\lambda_H$; without a critic κ", yscale="log", ylim=(0.2, 8.0))
        axis.set_yticks((0.2, 0.5, 1, 2, 4, 8), ("0.2", "0.5", "1", "2", "4", "8"))
        axis.minorticks_off()
        axis.set_title(checkpoint, fontsize=9)
    axes[0, 0].set_ylabel("error of $H$, of the best $ωH$ dashed")
    axes[0, 0].legend(fontsize=7, loc="upper left")
    return figure


def _draw(axis: Axes, rows: pd.DataFrame) -> None:
    for colour, (fit, group) in zip(PALETTE, rows.groupby("fit"), strict=False):
        decays = group.kappa * group.trace
        label = f"critic, {fit} ×" if fit else "no critic"
        axis.plot(decays, group.error, "o-", ms=3, color=colour, label=label)
        axis.plot(decays, group.scaled, "o--", ms=3, mfc="none", color=colour)
    axis.axhline(1.0, color="black", lw=0.6, ls=":")


STUDY = Study("network_critic", jobs, measure, draw, seeds=2)

if __name__ == "__main__":
    STUDY.main(str(__doc__))
