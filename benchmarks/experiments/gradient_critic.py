"""A critic for the cross-time terms of H: bias and error of the estimates of ∇²J.

    python -m benchmarks.experiments.gradient_critic

Random MDPs of four states with random ends of episodes, γ = 1, λ = 0.95, the exact V. The critic of
:mod:`~benchmarks.experiments.cross_time` has a value per state and is

- ``none``: CRPN's estimator;
- ``1x``, ``3x``: LSTD on other episodes of the policy, as many as H has, or three times as many;
- ``exact``; ``previous``: the exact critic of a policy one natural-gradient step away.

Errors are relative to the exact ∇²J.
"""

from __future__ import annotations

from itertools import product

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from stable_baselines3.common.env_util import make_vec_env
from torch import Tensor

from benchmarks.common.figures import PALETTE
from benchmarks.common.markdown import markdown
from benchmarks.common.table import Row
from benchmarks.exact import TabularEnv, TabularMDP, random_mdp
from benchmarks.experiments.cross_time import Chain, Critic, Steps, hessians
from benchmarks.experiments.reuse import N_ENVS, assign, natural_step
from benchmarks.experiments.study import Study
from sb3_crpn import CRPN
from sb3_crpn.arrays import FloatArray
from sb3_crpn.episodes import EpisodeBatch

STOPS = (0.4, 0.1)  # the largest probability that an episode ends with a step
HORIZON = 600  # episodes end by themselves before
N_EVALUATED = 2_000
N_FITS = 10
EPISODES = (10, 50, 200)
KAPPAS = (0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0)
CRITIC_KAPPAS = (0.9, 1.0)
TRACES = (0.0, 0.5, 0.9, 1.0)  # λ_H
FITS = {"1x": 1, "3x": 3}  # episodes of the critic, in those of H
KL = 0.02  # of a step to the previous policy
CRITICS = ("none", *FITS, "exact", "previous")
PRACTICAL = 50  # episodes of an update


def jobs(seeds: int) -> list[Row]:
    """Return one job per MDP."""
    return [{"stop": stop, "seed": seed} for seed in range(seeds) for stop in STOPS]


def measure(stop: float, seed: int) -> list[Row]:
    """Return bias, variance and error of every estimator on one MDP."""
    mdp = random_mdp(seed, horizon=HORIZON, gamma=1.0, concentration=0.3, max_stop=stop)
    generator = torch.Generator().manual_seed(seed)
    theta = torch.randn(mdp.n_parameters, dtype=torch.float64, generator=generator)
    model = make_model(mdp, theta, seed)
    chain = Chain(mdp, model.actor.vector)  # in the network's precision
    steps = Steps.of(chain, model.estimate_curvature(N_EVALUATED).gradient_batch)
    earlier = model.estimate_curvature(N_FITS * max(FITS.values()) * max(EPISODES)).gradient_batch
    truth, rows = mdp.hessian(chain.theta).numpy(), []
    for kappa in KAPPAS:
        kinds = critics(mdp, chain, earlier, kappa)
        for trace in TRACES if kappa in CRITIC_KAPPAS else (1.0,):
            crossed = steps.crossed(kappa, trace, len(mdp.initial))
            for (kind, n), found in kinds.items():
                if kind == "none" and trace < 1.0:  # a lower κ
                    continue
                estimates = [(chain.expected(b, kappa, trace), hessians(steps, crossed, b))
                             for b in found]  # fmt: skip
                setting = {"critic": kind, "kappa": kappa, "trace": trace, "episodes": n}
                rows.append(setting | moments(estimates, truth))
    return [row | {"length": mdp.mean_length(chain.theta)} for row in rows]


def make_model(mdp: TabularMDP, theta: Tensor, seed: int) -> CRPN:
    """Return CRPN at θ with the exact V."""
    model = CRPN(
        "MlpPolicy",
        make_vec_env(lambda: TabularEnv(mdp), N_ENVS, seed=seed),
        gamma=1.0,
        normalize_advantage=False,
        policy_kwargs={"net_arch": []},
        seed=seed,
        device="cpu",
    )
    assign(model, mdp, theta)
    return model


def critics(
    mdp: TabularMDP, chain: Chain, earlier: EpisodeBatch, kappa: float
) -> dict[tuple[str, int], list[Critic]]:
    """Return what each kind of critic is for each number of episodes of H."""
    n_states, d = len(mdp.initial), mdp.n_parameters
    zero = np.zeros((n_states, d))
    found = {("none", n): [Critic(zero, zero)] for n in EPISODES}
    if kappa not in CRITIC_KAPPAS:
        return found
    for (kind, ratio), n in product(FITS.items(), EPISODES):
        parts = [np.arange(ratio * n) + k * ratio * n for k in range(N_FITS)]
        found[kind, n] = [Steps.of(chain, earlier.take(p)).fit(kappa, n_states) for p in parts]
    previous = Chain(mdp, chain.theta - natural_step(mdp, chain.theta, KL))
    for kind, of in (("exact", chain), ("previous", previous)):
        found |= {(kind, n): [of.critic(kappa)] for n in EPISODES}
    return found


def moments(estimates: list[tuple[FloatArray, FloatArray]], truth: FloatArray) -> dict[str, float]:
    """Return the bias of H, means over critics, and an episode's variance.

    Parameters
    ----------
    estimates
        For each critic the expectation of H, [d, d], and H of single episodes, [E, d, d].
    truth
        ∇²J, [d, d].
    """
    expected = np.array([mean for mean, _ in estimates])
    between = expected.var(0, ddof=1).sum() / len(expected) if len(expected) > 1 else 0.0
    squared = ((expected.mean(0) - truth) ** 2).sum() - between
    squares = (truth**2).sum()
    return {
        "bias": float(max(squared, 0.0) / squares) ** 0.5,
        "squared_bias": float(((expected - truth) ** 2).sum((1, 2)).mean() / squares),
        "slope": float((expected.mean(0) * truth).sum() / squares),
        "variance": float(np.mean([each.var(0, ddof=1).sum() for _, each in estimates]) / squares),
    }


def with_errors(rows: pd.DataFrame, more: int = 1) -> pd.DataFrame:
    """Return the rows with the error of H from ``more`` times as many episodes, and of the best ωH.

    With p = ⟨E H, ∇²J⟩/‖∇²J‖² and the error e = E‖H - ∇²J‖²/‖∇²J‖², the least error of ωH is
    1 - p²/(e + 2p - 1).
    """
    error = rows.squared_bias + rows.variance / (more * rows.episodes)
    scaled = 1.0 - rows.slope**2 / (error + 2.0 * rows.slope - 1.0)
    return rows.assign(error=error, scaled=scaled)


def settings_table(rows: pd.DataFrame) -> str:
    """Return a Markdown table: bias and error at ``PRACTICAL`` episodes, medians over MDPs."""
    rows = with_errors(rows[rows.episodes == PRACTICAL])
    found = rows.groupby(["stop", "kappa", "trace", "critic"])[["bias", "error"]].median()
    body = []
    for stop, kappa, trace in product(STOPS, CRITIC_KAPPAS, TRACES):
        cells = []
        for kind in CRITICS:
            # without a critic only κ λ_H counts
            at = (kappa * trace, 1.0) if kind == "none" else (kappa, trace)
            key = (stop, *at, kind)
            known = key in found.index
            cells.append("{bias:.2f}, {error:.2f}".format(**found.loc[key]) if known else "-")
        body.append([f"{stop:g}", f"{kappa:g}", f"{trace:g}", *cells])
    return markdown(["stop", "κ", "λ_H", *CRITICS], body)


def episodes_table(rows: pd.DataFrame) -> str:
    """Return a Markdown table: errors by number of episodes, H and the best ωH, medians."""
    best = {kind: rows.critic == kind for kind in CRITICS}
    columns = {
        "κ = 0.9": (best["none"] & (rows.kappa == 0.9), 1),
        "κ = 1": (best["none"] & (rows.kappa == 1.0), 1),
        "best κ": (best["none"], 1),
        "best κ, 2 × episodes": (best["none"], 2),
        "best κ, 4 × episodes": (best["none"], 4),
        **{f"best critic, {kind}": (best[kind], 1) for kind in (*FITS, "previous")},
    }
    body = []
    for stop, n in product(STOPS, EPISODES):
        chosen = (rows.stop == stop) & (rows.episodes == n)
        cells = [_best(with_errors(rows[chosen & which], more)) for which, more in columns.values()]
        body.append([f"{stop:g}", n, *cells])
    return markdown(["stop", "episodes", *columns], body)


def _best(rows: pd.DataFrame) -> str:
    """Return the lowest medians of both errors, and of several settings theirs, (κ, λ_H)."""
    found = rows.groupby(["kappa", "trace"])[["error", "scaled"]].median()
    cells = []
    for column in ("error", "scaled"):
        kappa, trace = found[column].idxmin()
        setting = f" ({kappa:g}, {trace:g})" if trace < 1.0 else f" ({kappa:g})"
        cells.append(f"{found[column].min():.2f}{setting if len(found) > 1 else ''}")
    return "; ".join(cells)


def ratios_table(rows: pd.DataFrame) -> str:
    """Return a Markdown table: errors of one critic at ``PRACTICAL`` episodes, MDP by MDP."""
    rows = with_errors(rows[rows.episodes == PRACTICAL])
    rows = rows.set_index(["critic", "kappa", "trace", "stop", "seed"]).error.sort_index()
    chosen = rows["1x", 0.9, 0.5]
    body = []
    for kappa, stop in product(KAPPAS, STOPS):
        ratios = (chosen / rows["none", kappa, 1.0])[stop]
        spread = (f"{ratios.quantile(q):.2f}" for q in (0.5, 0.0, 1.0))
        body.append([f"{kappa:g}", f"{stop:g}", *spread])
    return markdown(["critic 1x (0.9, 0.5) / κ", "stop", "median", "lowest", "highest"], body)


def draw(rows: pd.DataFrame) -> Figure:
    """Draw the errors over λ_H, and print the tables."""
    print(settings_table(rows), episodes_table(rows), ratios_table(rows), sep="\n\n")
    figure, axes = plt.subplots(
        len(STOPS),
        len(EPISODES),
        squeeze=False,
        figsize=(9, 5.5),
        sharex=True,
        layout="constrained",
    )
    for (row, stop), (column, n) in product(enumerate(STOPS), enumerate(EPISODES)):
        axis, chosen = axes[row, column], with_errors(rows[rows.episodes == n])
        _draw(axis, chosen[chosen.stop == stop])
        axis.set_title(f"largest probability of an end {stop:g}, {n} episodes", fontsize=8)
        axes[row, 0].set_ylabel(r"error of $H$")
        axes[-1, column].set_xlabel(r"$\lambda_H$; without a critic κ")
    axes[0, 0].legend(fontsize=7)
    return figure


def _draw(axis: Axes, rows: pd.DataFrame) -> None:
    labels = {"none": "no critic"} | {kind: f"critic, {kind}" for kind in CRITICS[1:]}
    for colour, (kind, label) in zip(PALETTE, labels.items(), strict=False):
        chosen = rows[rows.critic == kind]
        if kind == "none":
            curve = chosen.groupby("kappa").error.median()
        else:
            curve = chosen[chosen.kappa == 1.0].groupby("trace").error.median()
        axis.plot(curve.index, curve, "o-", ms=3, color=colour, label=label)
    axis.axhline(1.0, color="black", lw=0.6, ls=":")
    axis.set_yscale("log")


STUDY = Study("gradient_critic", jobs, measure, draw, seeds=6)

if __name__ == "__main__":
    STUDY.main(str(__doc__))
