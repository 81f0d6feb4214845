"""Training with reused rollouts, corrected for the states that the old policies visited or not.

    python -m benchmarks.experiments.reuse_training

Each environment's entry at its ``target_kl`` and at four times it, with the Hessian and without. A
reused step is weighted by exp(clip(Σ_{j<i} κ^{i-j} log ρ_j, ±c)), as in `reuse`, or not. Seeds from
10 on, which no table of the benchmark reports.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import matplotlib.pyplot as plt
import pandas as pd
from matplotlib.figure import Figure

from benchmarks.common.figures import PALETTE
from benchmarks.common.intervals import interval
from benchmarks.common.markdown import estimate, markdown
from benchmarks.common.table import Row
from benchmarks.experiments.reuse import visitation_weights
from benchmarks.experiments.study import Study
from benchmarks.experiments.tasks import Returns, make_model
from benchmarks.learning.settings import resolve
from sb3_crpn import CRPN
from sb3_crpn.arrays import FloatArray
from sb3_crpn.episodes import EpisodeBatch, Replay

BUDGETS = {"CartPole-v1": 30_000, "Acrobot-v1": 40_000, "Pendulum-v1": 40_000}
FIRST_SEED = 10
FACTORS = (1, 4)
# c and κ; c = 0 corrects nothing, as CRPN
ARMS: dict[str, tuple[float, float]] = {
    "states as they are": (0.0, 1.0),
    "c = 1.5, κ = 1": (1.5, 1.0),
    "c = 1, κ = 0.95": (1.0, 0.95),
}
HESSIANS = ("auto", "none")


class VisitationReplay(Replay):
    """Replay whose steps are weighted for the states that the behaviour policy visited.

    Attributes
    ----------
    clip, decay
        c and κ.
    """

    clip: float
    decay: float

    def _reweight(
        self,
        batch: EpisodeBatch,
        values: FloatArray,
        terminal_values: FloatArray,
        ratios: FloatArray,
        **weighting: bool,
    ) -> EpisodeBatch:
        reused = super()._reweight(batch, values, terminal_values, ratios, **weighting)
        weights = visitation_weights(ratios, batch.lengths, self.clip, self.decay)
        return replace(reused, cost_advantages=weights * reused.cost_advantages)


def replay_of(model: CRPN, arm: str) -> VisitationReplay:
    """Return the model's replay with the weights of ``arm``."""
    replay = VisitationReplay(model.n_reused_rollouts, model.gamma, model.gae_lambda)
    replay.clip, replay.decay = ARMS[arm]
    return replay


def jobs(seeds: int) -> list[Row]:
    """Return one job per training run."""
    cases = itertools.product(
        range(FIRST_SEED, FIRST_SEED + seeds), BUDGETS, FACTORS, HESSIANS, ARMS
    )
    return [
        {"env": env, "factor": factor, "hessian": hessian, "arm": arm, "seed": seed}
        for seed, env, factor, hessian, arm in cases
    ]


def measure(env: str, factor: int, hessian: str, arm: str, seed: int) -> list[Row]:
    """Train once."""
    target = resolve("CRPN", env, {})[1].get("target_kl", 0.02)
    arguments: dict[str, Any] = {"target_kl": factor * target}
    if hessian == "none":
        arguments["hessian_shrinkage"] = 0.0
    model = make_model(env, seed, **arguments)
    model.replay = replay_of(model, arm)
    returns = Returns(BUDGETS[env])
    model.learn(BUDGETS[env], callback=returns)
    return [returns.summary()]


def table(rows: pd.DataFrame) -> str:
    """Return a Markdown table: mean return over training, a row per task, target and Hessian."""
    body = []
    for (env, factor, hessian), group in rows.groupby(["env", "factor", "hessian"], sort=False):
        runs = [group[group.arm == arm].mean_return for arm in ARMS]
        cells = ["-" if run.empty else estimate(interval(run), ".0f") for run in runs]
        body.append([env, f"{factor} ×", hessian, group.seed.nunique(), *cells])
    return markdown(["task", "target_kl", "Hessian", "seeds", *ARMS], body)


def draw(rows: pd.DataFrame) -> Figure:
    """Draw the mean returns; print the table."""
    print(table(rows))
    figure, axes = plt.subplots(1, len(BUDGETS), figsize=(9, 3), layout="constrained")
    for axis, env in zip(axes, BUDGETS, strict=True):
        cases = list(itertools.product(FACTORS, HESSIANS))
        for shift, (colour, arm) in enumerate(zip(PALETTE, ARMS, strict=False)):
            for position, (factor, hessian) in enumerate(cases):
                chosen = (rows.env == env) & (rows.factor == factor) & (rows.hessian == hessian)
                values = rows[chosen & (rows.arm == arm)].mean_return
                if values.empty:
                    continue
                mean, low, high = interval(values)
                axis.errorbar(
                    position + 0.15 * (shift - 1.5), mean, [[mean - low], [high - mean]],
                    fmt="o", ms=4, color=colour, label=arm if position == 0 else None,
                )  # fmt: skip
        axis.set_xticks(range(len(cases)), [f"{f} ×, {h}" for f, h in cases], fontsize=7)
        axis.set_title(env, fontsize=9)
    axes[0].legend(fontsize=7)
    axes[0].set_ylabel("mean return over training")
    return figure


STUDY = Study("reuse_training", jobs, measure, draw, seeds=5)

if __name__ == "__main__":
    STUDY.main(str(__doc__))
