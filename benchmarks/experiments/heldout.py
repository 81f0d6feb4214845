"""The decrease of a single step on held-out episodes.

    python -m benchmarks.experiments.heldout

Training with an environment's entry stops early in learning. Fresh episodes of that policy are
dealt to batches of two rollouts' size. Each of some batches makes g and the Krylov space K(F, g),
and on it steps of a given KL divergence with several Hessians:

- ``none``: H = 0, the natural gradient;
- ``own``: H of the batch itself; ``shrunk``: times the James-Stein factor of its halves;
- ``others``: H of eight other batches; ``all``: of these and its own.

The batches left over judge the step: slope, curvature and gain -(g·s + ½ sᵀHs) from *their* g and
H (κ as in training). Units are standard deviations of the advantage, per step of an episode, and
slope and curvature are those along a step of length √(sᵀFs) = 1.
"""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.common.figures import PALETTE
from benchmarks.common.intervals import interval
from benchmarks.common.markdown import estimate, markdown
from benchmarks.common.table import Row
from benchmarks.experiments.steps import (
    Subspace,
    fisher_subspace,
    gradient_sums,
    hessian_sums,
    n_steps,
    parabola_kl,
    step_of_kl,
)
from benchmarks.experiments.study import Study
from benchmarks.experiments.tasks import make_model
from sb3_crpn import CRPN
from sb3_crpn.curvature import HESSIAN_ESTIMATORS, JamesStein
from sb3_crpn.curvature.derivatives import EpisodeDerivatives
from sb3_crpn.episodes import EpisodeBatch

# Timesteps of a checkpoint early in learning
CHECKPOINTS = {
    "CartPole-v1": 8_000,
    "Acrobot-v1": 15_000,
    "Pendulum-v1": 15_000,
    "LunarLander-v3": 40_000,
    "HalfCheetah-v5": 50_000,
}
KLS = (0.005, 0.02, 0.05, 0.1)
HESSIANS = ("none", "own", "shrunk", "others", "all")
N_BATCHES, N_OTHERS, N_TRIALS = 16, 8, 4
DIM = 10  # of the Krylov space, CRPN's default


def jobs(seeds: int) -> list[Row]:
    """Return one job per checkpoint."""
    return [{"env": env, "seed": seed} for seed in range(seeds) for env in CHECKPOINTS]


def measure(env: str, seed: int) -> list[Row]:
    """Train to the checkpoint and evaluate steps there."""
    model = make_model(env, seed)
    model.learn(CHECKPOINTS[env])
    length = float(np.mean([episode["l"] for episode in model.ep_info_buffer or ()]))
    per_batch = max(2, round(2 * model.n_steps * model.n_envs / length))
    return judge_steps(model, per_batch, np.random.default_rng(seed))


def judge_steps(model: CRPN, per_batch: int, rng: np.random.Generator) -> list[Row]:
    """Make steps from batches of ``per_batch`` new episodes, and evaluate them on others."""
    batches = model.estimate_curvature(N_BATCHES * per_batch).gradient_batch.split(N_BATCHES)
    model.policy.set_training_mode(False)
    estimator = HESSIAN_ESTIMATORS.resolve(model.hessian_estimator, model)

    def derivatives(batch: EpisodeBatch) -> EpisodeDerivatives:
        return EpisodeDerivatives(model.policy, model.actor, batch, estimator)

    groups = [derivatives(batch) for batch in batches]
    sizes, gradients = n_steps(groups), gradient_sums(groups)
    rows: list[Row] = []
    for own in range(N_TRIALS):
        order = rng.permutation([batch for batch in range(N_BATCHES) if batch != own])
        others, test = torch.from_numpy(order).split([N_OTHERS, N_BATCHES - 1 - N_OTHERS])
        gradient = gradients[own] / sizes[own]
        space = fisher_subspace([groups[own]], gradient, model.fisher_damping, DIM)
        forms = hessian_sums(groups, space.basis)
        omega = _shrinkage([derivatives(half) for half in batches[own].split(2)], space)
        hessians = _hessians(forms, sizes, own, others, omega)
        judges = _Judges(
            space,
            own=(space.basis.T @ gradient, hessians["own"]),
            test=(
                space.basis.T @ gradients[test].sum(0) / sizes[test].sum(),
                forms[test].sum(0) / sizes[test].sum(),
            ),
        )
        rows += [
            {"trial": own, "kl": kl, "hessian": name} | judges.judge(hessian, kl)
            for kl in KLS
            for name, hessian in hessians.items()
        ]
    return rows


def _shrinkage(halves: list[EpisodeDerivatives], space: Subspace) -> float:
    """Return CRPN's factor ω."""
    sizes = n_steps(halves)
    forms = hessian_sums(halves, space.basis) / sizes[:, None, None]
    return JamesStein().factor(forms, sizes / sizes.sum())


def _hessians(
    forms: Tensor, sizes: Tensor, own: int, others: Tensor, omega: float
) -> dict[str, Tensor]:
    def mean(groups: Tensor) -> Tensor:
        return forms[groups].sum(0) / sizes[groups].sum()

    alone = torch.tensor([own])
    return {
        "none": torch.zeros_like(forms[0]),
        "own": mean(alone),
        "shrunk": omega * mean(alone),
        "others": mean(others),
        "all": mean(torch.cat([alone, others])),
    }


class _Judges:
    """g and H of the step's own batch and of the test's, on the subspace."""

    def __init__(
        self, space: Subspace, own: tuple[Tensor, Tensor], test: tuple[Tensor, Tensor]
    ) -> None:
        self._space, self._own, self._test = space, own, test

    def judge(self, hessian: Tensor, kl: float) -> Row:
        """Return the decrease by the step of ``hessian``, on its own batch and held out."""
        step = step_of_kl(self._own[0], hessian, self._space, kl)
        length = self._space.length(step)
        row: Row = {"length": length}
        for name, (gradient, form) in (("own", self._own), ("test", self._test)):
            slope, curvature = -float(gradient @ step), float(step @ form @ step)
            row |= {
                f"{name}_slope": slope / length,
                f"{name}_curvature": curvature / length**2,
                f"{name}_gain": slope - 0.5 * curvature,
            }
        return row


def table(rows: pd.DataFrame) -> str:
    """Return two Markdown tables: the step of H = 0, and the differences of the other steps."""
    shortest = rows[(rows.hessian == "none") & (rows.kl == KLS[0])]
    natural = [_confirmed(str(env), group) for env, group in shortest.groupby("env", sort=False)]
    gains = []
    for (env, kl), group in rows.groupby(["env", "kl"], sort=False):
        table = 1e3 * group.pivot_table("test_gain", ["seed", "trial"], "hessian")
        cells = [estimate(interval(table[name] - table["none"]), "+.1f") for name in HESSIANS[1:]]
        gains.append([env, f"{kl:g}", f"{table['none'].mean():.1f}", *cells])
    head = ["task", "share of slope confirmed", "curvature, own batch", "others", "best KL"]
    return (
        markdown(head, natural)
        + "\n\n"
        + markdown(["task", "KL", "gain of H = 0, 10⁻³", *HESSIANS[1:]], gains)
    )


def _confirmed(env: str, rows: pd.DataFrame) -> list[str]:
    """Return the held-out slope and curvature of natural-gradient steps, ½ (slope/curvature)²."""
    slope, curvature = rows.test_slope.mean(), rows.test_curvature.mean()
    share = slope / rows.own_slope.mean()
    numbers = [share, rows.own_curvature.mean(), curvature]
    return [env, *(f"{x:.2f}" for x in numbers), f"{parabola_kl(slope, curvature):.3f}"]


def draw(rows: pd.DataFrame) -> Figure:
    """Draw the gains against the divergence, a panel a task; print the tables."""
    print(table(rows))
    envs = list(rows.env.unique())
    figure, axes = plt.subplots(1, len(envs), figsize=(2.6 * len(envs), 3), layout="constrained")
    for axis, env in zip(np.atleast_1d(axes), envs, strict=True):
        _draw_gains(axis, rows[rows.env == env])
        axis.set_title(env, fontsize=9)
    np.atleast_1d(axes)[0].set_ylabel("gain on other episodes, $10^{-3}$")
    np.atleast_1d(axes)[0].legend(fontsize=7)
    return figure


def _draw_gains(axis: Axes, rows: pd.DataFrame) -> None:
    for colour, name in zip(PALETTE, HESSIANS, strict=False):
        gains = rows[rows.hessian == name].groupby("kl").test_gain.mean()
        axis.plot(gains.index, 1e3 * gains, "o-", ms=3, color=colour, label=f"H: {name}")
    axis.axhline(0.0, color="k", lw=0.6)
    axis.set(xscale="log", xlabel="KL divergence")
    axis.set_xticks(KLS, [f"{kl:g}" for kl in KLS])
    axis.minorticks_off()


STUDY = Study("heldout", jobs, measure, draw, seeds=2)

if __name__ == "__main__":
    STUDY.main(str(__doc__))
