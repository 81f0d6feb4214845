"""The length of a step from confirmed slope and curvature.

    python -m benchmarks.experiments.confirmed

Training with an environment's entry, its steps untouched. Every update records, in standard
deviations of the advantage per step of an episode and along a step of length √(sᵀFs) = 1:

- slope and curvature of the natural-gradient step, cross-fitted (`crossfit`);
- the slope that the *next* rollout finds along the step taken: a second witness, made from
  independent episodes. It is positive if the step ended before the cost's minimum along it.

The divergence ½ (slope/curvature)² of means over updates is where the cost along the step would be
least, to second order. It is compared with the entry's ``target_kl``, chosen by hand.
"""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.common.figures import PALETTE
from benchmarks.common.intervals import interval
from benchmarks.common.markdown import estimate, markdown
from benchmarks.common.table import Row
from benchmarks.experiments.crossfit import CrossFit, confirm_natural_step
from benchmarks.experiments.steps import parabola_kl
from benchmarks.experiments.study import Study
from benchmarks.experiments.tasks import Returns, make_model
from sb3_crpn import CRPN
from sb3_crpn.algorithm.update import UpdateData
from sb3_crpn.curvature import CurvatureEstimate

ENVS = ("CartPole-v1", "Pendulum-v1", "Acrobot-v1", "HalfCheetah-v5", "LunarLander-v3")
BUDGET = 50_000


def jobs(seeds: int) -> list[Row]:
    """Return one job per training run."""
    return [{"env": env, "seed": 10 + seed} for seed in range(seeds) for env in ENVS]


def measure(env: str, seed: int) -> list[Row]:
    """Train once; return a row per update."""
    model = make_model(env, seed, ConfirmedCRPN)
    assert isinstance(model, ConfirmedCRPN)
    model.learn(BUDGET, callback=Returns(BUDGET))
    return model.records


class ConfirmedCRPN(CRPN):
    """CRPN that records the slope and curvature of each step on held-out episodes.

    Attributes
    ----------
    records
        One row per update.
    """

    def _setup_model(self) -> None:
        self.records: list[Row] = []
        self._last_step: Tensor | None = None
        super()._setup_model()

    def train(self) -> None:
        """Update the policy, and record the step."""
        before = self.actor.vector
        super().train()
        assert self.last_update is not None
        accepted = self.last_update.accepted
        self._last_step = self.actor.vector - before if accepted else None
        self.records[-1] |= {
            "length": (2.0 * self.last_update.kl_divergence) ** 0.5 if accepted else float("nan"),
            "target_kl": self.last_update.target_kl,
            "next_slope": float("nan"),
        }

    def _estimate(self, data: UpdateData) -> CurvatureEstimate:
        folds = CrossFit(self, data.fresh, data.earlier)
        self._record_next_slope(folds.fresh_gradient)
        record: Row = {"update": len(self.records), "timesteps": self.num_timesteps}
        confirmed = confirm_natural_step(folds) if folds.n_folds > 1 else None
        for name in ("claimed_slope", "slope", "curvature"):
            record[name] = getattr(confirmed, name, float("nan"))
        self.records.append(record)
        return super()._estimate(data)

    def _record_next_slope(self, gradient: Tensor) -> None:
        """Add this rollout's estimate of the last step to its update."""
        if self._last_step is not None:
            length = self.records[-1]["length"]
            self.records[-1]["next_slope"] = -float(gradient @ self._last_step) / length


def secant_curvature(rows: pd.DataFrame) -> float:
    """Return the secant's curvature from the next rollouts' slopes, by least squares."""
    drop = rows.slope - rows.next_slope
    return float((rows.length * drop).sum() / (rows.length**2)[drop.notna()].sum())


def table(rows: pd.DataFrame) -> str:
    """Return a Markdown table, a row per task and third of training; means over updates, seeds."""
    body = []
    for env, group in rows.groupby("env", sort=False):
        third = (3 * group.timesteps / (BUDGET + 1)).astype(int).clip(upper=2)
        for part, chosen in group.groupby(third):
            slope, secant = chosen.slope.mean(), secant_curvature(chosen)
            body.append(
                [
                    env,
                    f"{group.target_kl.max():g}",
                    part + 1,
                    f"{slope / chosen.claimed_slope.mean():.2f}",
                    estimate(interval(chosen.slope.dropna()), ".3f"),
                    estimate(interval(chosen.curvature.dropna()), ".2f"),
                    f"{parabola_kl(slope, chosen.curvature.mean()):.3f}",
                    f"{secant:.2f}",
                    f"{parabola_kl(slope, secant):.3f}",
                ]
            )
    head = ["task", "entry's target_kl", "third", "share of slope confirmed", "slope",
            "curvature, cross-fitted", "its KL", "curvature, secant", "its KL"]  # fmt: skip
    return markdown(head, body)


def draw(rows: pd.DataFrame) -> Figure:
    """Draw the recommended divergence along training and the entry's. Print the table."""
    print(table(rows))
    envs = rows.groupby("env", sort=False)
    size = (2.6 * len(envs), 2.8)
    figure, axes = plt.subplots(1, len(envs), figsize=size, sharey=True, layout="constrained")
    axes = np.atleast_1d(axes)
    for axis, (env, group) in zip(axes, envs, strict=True):
        for style, (_, run) in zip(("-", "--"), group.groupby("seed"), strict=False):
            for colour, (name, kls) in zip(PALETTE, recommendations(run).items(), strict=False):
                axis.plot(run.timesteps, kls.clip(1e-4, 1.0), style, color=colour, label=name)
        axis.axhline(group.target_kl.max(), color="k", ls=":", lw=1.0, label="entry")
        axis.set(yscale="log", xlabel="timesteps")
        axis.set_title(env, fontsize=9)
    axes[0].set_ylabel("½ (slope / curvature)²")
    axes[0].legend(fontsize=7)
    return figure


def recommendations(run: pd.DataFrame) -> dict[str, pd.Series]:
    """Return ½ (slope/curvature)² of weighted means along a run, by the source of the curvature."""
    drop = run.length * (run.slope - run.next_slope)
    squares = (run.length**2).where(drop.notna())
    curvatures = {
        "cross-fitted": _faded(run.curvature),
        "secant": _faded(drop) / _faded(squares),
    }
    slope = _faded(run.slope).clip(lower=0.0)
    return {name: 0.5 * (slope / c.clip(lower=1e-3)) ** 2 for name, c in curvatures.items()}


def _faded(values: pd.Series) -> pd.Series:
    return values.ewm(alpha=0.1).mean()


STUDY = Study("confirmed", jobs, measure, draw, seeds=2)

if __name__ == "__main__":
    STUDY.main(str(__doc__))
