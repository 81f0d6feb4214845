"""The paper's algorithms on CartPole-v1 at the paper's setting, and changes that help.

    python -m benchmarks.experiments.cartpole --jobs 2

Linear features, 50 episodes an update, α = 1000, γ = 0.99, 100 updates; then one change at a time,
and the few that help together. Solved means what Gymnasium's threshold asks for: a mean return of
475 over 100 consecutive episodes, here those of two updates, of the stochastic policy in training.
With 1000 episodes an update, which only shows what the noise does, it is over 2000.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks.common.figures import PALETTE
from benchmarks.common.intervals import interval
from benchmarks.common.markdown import estimate, markdown
from benchmarks.common.table import Row
from benchmarks.experiments.study import Study
from sb3_crpn import ACRPN, CRPN, PAPER
from sb3_crpn.vec_env import GymnasiumVecEnv

SETTING: dict[str, Any] = PAPER | {
    "n_episodes": 50,
    "alpha": 1e3,
    "gamma": 0.99,
    "policy_kwargs": {"net_arch": []},
}
N_UPDATES, SOLVED = 100, 475.0
CAUSAL = {"hessian_estimator": "causal", "hessian_lambda": 1.0}
# Differences from SETTING. Only 1000 episodes change the budget
CHANGES: dict[str, dict[str, Any]] = {
    "": {},
    "alpha 3000": {"alpha": 3e3},
    "alpha 300": {"alpha": 3e2},
    "no Hessian": {"hessian_shrinkage": 0.0},
    "shrinkage": {"hessian_shrinkage": "auto"},
    "causal": CAUSAL,
    "KL 0.02": {"target_kl": 0.02},
    "baseline": {"baseline": True},
    "baseline, KL 0.02": {"baseline": True, "target_kl": 0.02},
    "baseline, causal": {"baseline": True} | CAUSAL,
    "baseline, alpha 300": {"baseline": True, "alpha": 3e2},
    "baseline, causal, alpha 300": {"baseline": True, "alpha": 3e2} | CAUSAL,
    "1000 episodes": {"n_episodes": 1000},
}
ACRPN_CHANGES = ("", "baseline", "baseline, alpha 300")
DRAWN = ("", "no Hessian", "KL 0.02", "baseline", "baseline, alpha 300", "1000 episodes")


def jobs(seeds: int) -> list[Row]:
    """Return one job per training run."""
    kinds = [("CRPN", change) for change in CHANGES]
    kinds += [("ACRPN", change) for change in ACRPN_CHANGES]
    return [
        {"algorithm": algorithm, "change": change, "seed": seed}
        for seed in range(seeds)
        for algorithm, change in kinds
    ]


def measure(algorithm: str, change: str, seed: int, n_updates: int = N_UPDATES) -> list[Row]:
    """Train once, every episode of an update in an environment of its own; a row per update."""
    arguments = SETTING | CHANGES[change]
    envs = gym.make_vec("CartPole-v1", arguments["n_episodes"], "vector_entry_point")
    algorithm_class = {"CRPN": CRPN, "ACRPN": ACRPN}[algorithm]
    model = algorithm_class(
        "MlpPolicy", GymnasiumVecEnv(envs), seed=seed, device="cpu", **arguments
    )
    updates = _Updates(n_updates)
    model.learn(10**12, callback=updates)
    return updates.rows


class _Updates(BaseCallback):
    """Records data and result of each update, and ends training after the last."""

    def __init__(self, n_updates: int) -> None:
        super().__init__()
        self.rows: list[Row] = []
        self._n_updates = n_updates
        self._mean_return: float | None = None  # before the first rollout

    def _on_rollout_start(self) -> None:
        if self._mean_return is not None:
            log = self.logger.name_to_value
            self.rows.append(
                {
                    "update": len(self.rows) + 1,
                    "mean_return": self._mean_return,
                    "gradient_noise": log["train/gradient_noise"],
                    "negative_share": _negative_share(log),
                    "kl_divergence": log["train/kl_divergence"],
                }
            )

    def _on_step(self) -> bool:
        return len(self.rows) < self._n_updates

    def _on_rollout_end(self) -> None:
        lengths = self.model.rollout_buffer.lengths  # type: ignore[attr-defined]
        self._mean_return = float(lengths.mean())  # of the update's episodes, no others


def _negative_share(log: dict[str, Any]) -> float:
    """Return -ωλ_min(H) as a share of the multiplier (α/2)‖Δ‖, of which 1 is the hard case."""
    most_negative: float = log["train/hessian_shrinkage"] * log["train/lambda_min"]  # ACRPN: NaN
    return -most_negative / log["train/multiplier"]


def draw(rows: pd.DataFrame) -> Figure:
    """Draw the two panels and print the table."""
    print(table(rows))
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    _draw_curves(axes[0], rows[rows.algorithm == "CRPN"])
    _draw_changes(axes[1], rows[rows.algorithm == "CRPN"])
    return figure


def table(rows: pd.DataFrame) -> str:
    """Return a Markdown table: medians over seeds with intervals."""
    body = []
    for (algorithm, change), group in rows.groupby(["algorithm", "change"], sort=False):
        runs = [run for _, run in group.groupby("seed")]
        pairs = [_pair_means(run) for run in runs]
        solved = [2 + int(np.argmax(pair >= SOLVED)) for pair in pairs if pair.max() >= SOLVED]
        cells = [
            str(algorithm),
            str(change) or "nothing",
            f"{len(solved)} of {len(runs)}",
            ", ".join(map(str, sorted(solved))),
            _cell([pair.max() for pair in pairs], ".0f"),
            _cell([run.mean_return.tail(10).mean() for run in runs], ".0f"),
            _cell([run.gradient_noise.median() for run in runs], ".2f"),
            _cell([run.negative_share.median() for run in runs], ".2f"),
            _cell([run.kl_divergence.max() for run in runs], ".2f"),
        ]
        body.append(cells)
    head = ["", "changed", "solved", "at update", "best mean of 100 episodes",
            "mean of the last 10 updates", "noise of g", "negative share",
            "largest KL of an update"]  # fmt: skip
    return markdown(head, body)


def _pair_means(run: pd.DataFrame) -> NDArray[np.float64]:
    """Return the mean return over each two successive updates."""
    returns: NDArray[np.float64] = run.mean_return.to_numpy()
    return (returns[1:] + returns[:-1]) / 2


def _cell(values: list[float], spec: str) -> str:
    if np.isnan(values).any():  # not logged
        return "-"
    return estimate(interval(values, statistic=np.median), spec)


def _draw_curves(axis: Axes, rows: pd.DataFrame) -> None:
    for colour, change in zip(PALETTE, DRAWN, strict=False):
        runs = rows[rows.change == change].pivot_table("mean_return", "update", "seed")
        axis.plot(runs.index, runs.mean(axis=1), color=colour, label=change or "the paper's")
    axis.axhline(SOLVED, color="0.4", lw=0.8, ls=":")
    axis.set(xlabel="update", ylabel="mean return of its episodes")
    axis.legend(fontsize=7)
    axis.set_title("mean over seeds", fontsize=9)


def _draw_changes(axis: Axes, rows: pd.DataFrame) -> None:
    """Draw the sorted KL divergences of the updates."""
    for colour, change in zip(PALETTE, DRAWN, strict=False):
        sizes = np.sort(rows[rows.change == change].kl_divergence.to_numpy())
        share = 1.0 - np.arange(len(sizes)) / len(sizes)
        axis.plot(sizes, share, color=colour, label=change or "the paper's")
    axis.set(xscale="log", yscale="log", xlim=(1e-4, None))
    axis.set(xlabel="KL divergence of an update", ylabel="share of updates with more")
    axis.set_title("how far an update goes", fontsize=9)


STUDY = Study("cartpole", jobs, measure, draw, seeds=5)

if __name__ == "__main__":
    STUDY.main(str(__doc__))
