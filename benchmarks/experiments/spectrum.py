"""The spectrum of ∇²J along training.

    python -m benchmarks.experiments.spectrum

CRPN with its default arguments and a 64×64 network on CartPole-v1 and Pendulum-v1. At checkpoints
two Hessians are estimated from fresh episodes of the stochastic policy (50 on CartPole-v1, of 500
steps once it is solved, and 100 of 200 steps on Pendulum-v1):

- ∇²J itself, without bias: the causal estimator at κ = 1, whole returns-to-go, discounted
  visitation, the critic as baseline;
- CRPN's own: κ = 0.9, GAE(0.95), normalised advantages, no discount of the visitation. Its units
  are standard deviations of the advantage.

Lanczos gives the extreme eigenvalues and the spectral density. Sampling noise alone widens the
spectrum of an estimate. So the extreme eigenvectors v are also computed from one half of the
episodes, and vᵀHv is measured on the other half, both ways round: without bias if both halves are
independent, hence on average no more extreme than the truth.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, eigsh
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.common.figures import PALETTE
from benchmarks.common.table import Row
from benchmarks.experiments.study import Study
from sb3_crpn import CRPN
from sb3_crpn.curvature import Causal
from sb3_crpn.curvature.derivatives import EpisodeDerivatives
from sb3_crpn.episodes import EpisodeBatch
from sb3_crpn.episodes.batch import episode_starts
from sb3_crpn.sosp.episodes import collect_episodes, preserve_state, with_baseline
from sb3_crpn.sosp.spectrum import Spectrum, lanczos_spectrum

Operator = Callable[[torch.Tensor], torch.Tensor]

CHECKPOINTS = {
    "CartPole-v1": (0, 5_000, 10_000, 20_000, 30_000, 50_000),
    "Pendulum-v1": (0, 10_000, 25_000, 50_000, 75_000, 100_000),
}
# No replay, so that the policies do not depend on the defaults of replay
SETTINGS: dict[str, int] = {
    "n_steps": 2048,
    "n_reused_rollouts": 0,
    "n_critic_updates": 20,
    "krylov_dim": 15,
}
N_EPISODES = {"CartPole-v1": 50, "Pendulum-v1": 100}
N_ENVS = 8
HESSIANS = {"own": ("-", "CRPN's"), "unbiased": (":", "unbiased")}
ENDS = {"max": (PALETTE[1], "largest"), "min": (PALETTE[0], "smallest")}
# Relative accuracy of the folds' eigenvalues: far below their noise
TOLERANCE = 0.01


def jobs(seeds: int) -> list[Row]:
    """Return one job per training run."""
    return [{"env": env, "seed": seed} for seed in range(seeds) for env in CHECKPOINTS]


def measure(env: str, seed: int) -> list[Row]:
    """Train once; return a row per checkpoint."""
    checkpoints = _Checkpoints(env, seed)
    model = CRPN("MlpPolicy", make_vec_env(env, 1, seed=seed), seed=seed, device="cpu", **SETTINGS)
    model.learn(CHECKPOINTS[env][-1], callback=checkpoints)
    return checkpoints.rows


class _Checkpoints(BaseCallback):
    """Examines ∇²J at the first update after each checkpoint."""

    def __init__(self, env: str, seed: int) -> None:
        super().__init__()
        self.rows: list[Row] = []
        self._due = list(CHECKPOINTS[env])
        self._n_episodes = N_EPISODES[env]
        self._env = make_vec_env(env, N_ENVS, seed=1000 + seed)
        self._rng = np.random.default_rng(seed)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self._examine_if_due()

    def _on_training_end(self) -> None:
        self._examine_if_due()

    def _examine_if_due(self) -> None:
        if self._due and self.num_timesteps >= self._due[0]:
            checkpoint = {"checkpoint": self._due.pop(0), "timesteps": self.num_timesteps}
            self.rows += [checkpoint | row for row in self._examine()]

    def _examine(self) -> list[Row]:
        model, seed = self.model, int(self._rng.integers(2**31))
        assert isinstance(model, CRPN)
        with preserve_state(model.policy, self._env, seed):
            batch = collect_episodes(model.policy, self._env, self._n_episodes, gamma=model.gamma)
            value = -float(batch.cost_advantages[episode_starts(batch.lengths)].mean())
            batch = with_baseline(model.policy, batch, model.gamma)
            own = model.estimate_curvature(self._n_episodes, self._env).gradient_batch
            halves = {
                "unbiased": _halves(model, batch, 1.0),
                "own": _halves(model, own, model.hessian_lambda),
            }
            return [
                {"hessian": name, "discounted_return": value}
                | _examine_spectrum(products, len(model.actor), seed)
                for name, products in halves.items()
            ]


def _halves(model: CRPN, batch: EpisodeBatch, kappa: float) -> list[Operator]:
    """Return the products with the Hessians of both folds of the episodes."""
    weights = Causal(kappa)
    return [
        EpisodeDerivatives(model.policy, model.actor, part, weights).hessian_product
        for part in batch.split(2)
    ]


def _examine_spectrum(halves: list[Operator], size: int, seed: int) -> Row:
    generator = torch.Generator().manual_seed(seed)
    start = torch.randn(size, dtype=torch.float64, generator=generator)
    spectrum = lanczos_spectrum(lambda v: 0.5 * (halves[0](v) + halves[1](v)), start, generator)
    checks = []
    for half, other in itertools.permutations(halves):
        operator = LinearOperator(
            (size, size), lambda v, half=half: _apply(half, v), dtype=np.float64
        )
        _, vectors = eigsh(operator, k=2, which="BE", tol=TOLERANCE, v0=start.numpy())
        checks.append([float(v @ _apply(other, v)) for v in vectors.T])
    (low, high), (other_low, other_high) = checks
    return {
        "lambda_min": float(spectrum.values[0]),
        "lambda_max": float(spectrum.values[-1]),
        "checked_min": (low + other_low) / 2,
        "checked_max": (high + other_high) / 2,
        "ritz_values": _listed(spectrum.values),
        "ritz_weights": _listed(spectrum.weights),
    }


def _apply(product: Operator, vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the product with a NumPy vector."""
    return product(torch.from_numpy(vector.ravel())).numpy()


def _listed(values: NDArray[np.float64]) -> str:
    return " ".join(f"{value:.5g}" for value in values)


def draw(rows: pd.DataFrame) -> Figure:
    """Draw eigenvalues, their confirmed shares and densities. Print the medians."""
    for end in ENDS:
        rows[f"confirmed_{end}"] = rows[f"checked_{end}"] / rows[f"lambda_{end}"]
    columns = ["discounted_return", "lambda_min", "confirmed_min", "lambda_max", "confirmed_max"]
    medians = rows.groupby(["env", "hessian", "checkpoint"])[columns].median()
    print(medians.to_string(float_format="{:.3g}".format))
    figure, axes = plt.subplots(2, 3, figsize=(11, 6), layout="constrained")
    for (left, middle, right), env in zip(axes, CHECKPOINTS, strict=True):
        chosen = rows[rows.env == env]
        own = chosen[chosen.hessian == "own"]
        _draw_eigenvalues(left, own)
        _draw_confirmed(middle, chosen)
        _draw_densities(right, own[own.seed == own.seed.min()])
        left.set_title(f"{env}: extreme eigenvalues of CRPN's Hessian", fontsize=9)
        middle.set_title("what other episodes confirm of them", fontsize=9)
        right.set_title("spectral density, one seed", fontsize=9)
    axes[0, 0].legend()
    axes[0, 1].legend(fontsize=7)
    return figure


def _curve(axis: Axes, table: pd.DataFrame, colour: str, style: str, label: str) -> None:
    """Draw the median over seeds, and the seeds."""
    axis.plot(table.index, table.median(axis=1), style, color=colour, label=label)
    axis.plot(table.index, table, "o", ms=3, color=colour, alpha=0.4)


def _draw_eigenvalues(axis: Axes, rows: pd.DataFrame) -> None:
    for end, (colour, name) in ENDS.items():
        table = rows.pivot_table(index="checkpoint", columns="seed", values=f"lambda_{end}")
        _curve(axis, table.abs(), colour, "-", f"$|\\lambda_{{{end}}}|$, {name}")
    axis.set(yscale="log", xlabel="training timesteps", ylabel="median and seeds")


def _draw_confirmed(axis: Axes, rows: pd.DataFrame) -> None:
    for hessian, (style, label) in HESSIANS.items():
        for end, (colour, name) in ENDS.items():
            table = rows[rows.hessian == hessian].pivot_table(
                index="checkpoint", columns="seed", values=f"confirmed_{end}"
            )
            _curve(axis, table.clip(-1.0, 1.2), colour, style, f"{name}, {label}")
    axis.axhline(0.0, color="k", lw=0.6)
    axis.set(
        xlabel="training timesteps", ylabel="part that other episodes confirm", ylim=(-1.1, 1.3)
    )


def _draw_densities(axis: Axes, rows: pd.DataFrame) -> None:
    colours = plt.get_cmap("viridis")(np.linspace(0.0, 0.9, len(rows)))
    for colour, (_, row) in zip(colours, rows.iterrows(), strict=True):
        values, weights = (np.array(row[k].split(), float) for k in ("ritz_values", "ritz_weights"))
        # in the coordinate asinh λ, which is logarithmic on both sides of ±1
        values = np.arcsinh(values)
        points = np.linspace(values[0] - 1.0, values[-1] + 1.0, 500)
        spectrum = Spectrum(values, weights, values[:1], torch.empty(0), 0.0)
        density = spectrum.density(points, width=0.15)
        axis.semilogy(points, density, color=colour, lw=1.2, label=f"{row.checkpoint:,}")
    ticks = np.array([-10_000, -1000, -100, -10, 0, 10, 100, 1000, 10_000])
    low, high = axis.get_xlim()
    ticks = ticks[(np.arcsinh(ticks) >= low) & (np.arcsinh(ticks) <= high)]
    axis.set_xticks(np.arcsinh(ticks), [f"{tick:g}" for tick in ticks], fontsize=7)
    axis.set(xlabel="eigenvalue λ, scaled as asinh λ", ylabel="density", ylim=(1e-5, 10.0))
    axis.legend(title="timesteps", fontsize=6, title_fontsize=6)


STUDY = Study("spectrum", jobs, measure, draw, seeds=3)

if __name__ == "__main__":
    STUDY.main(str(__doc__))
