"""Training with step lengths from held-out episodes, against the entry's ``target_kl``.

    python -m benchmarks.experiments.auto_kl

``entry`` is the environment's entry, its ``target_kl`` chosen by hand: its runs are those of
`benchmarks.learning`, as far as the budget here goes. ``auto`` sets the target of every update to
½ (slope/curvature)², between a tenth and five times 0.02. The slope is cross-fitted (`crossfit`).
The curvature is the secant's, (slope - next slope)/length by least squares, where the next slope is
what the following rollout finds along the step: in `confirmed` it is the less noisy of the two
witnesses. Both are means in which the past fades by 0.9 an update. CRPN's factor that shortens the
steps of solved tasks stays: there held-out episodes confirm the critic's error, which does not
depend on them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.common.figures import PALETTE
from benchmarks.common.intervals import interval
from benchmarks.common.markdown import estimate, markdown
from benchmarks.common.table import Row
from benchmarks.experiments.confirmed import ConfirmedCRPN
from benchmarks.experiments.steps import parabola_kl
from benchmarks.experiments.study import Study
from benchmarks.experiments.tasks import Returns, make_model
from benchmarks.learning.settings import resolve
from benchmarks.learning.store import RESULTS, read_curves
from sb3_crpn.episodes import EpisodeBatch

ENVS = ("CartPole-v1", "Pendulum-v1", "Acrobot-v1")
BUDGET = 30_000
FRACTIONS = {"auto": 1.0, "a fifth of auto": 0.2}
DEFAULT_KL = 0.02
LOWEST, HIGHEST = 0.1, 5.0  # of the target, in terms of DEFAULT_KL
MEMORY = 0.9  # by which the past fades in an update


class AutoKL(ConfirmedCRPN):
    """CRPN whose target is c/2 (slope/curvature)² of confirmed slope and secant curvature.

    Attributes
    ----------
    fraction
        c.
    """

    fraction: float = 1.0

    def _setup_model(self) -> None:
        # exponentially weighted sums of 1, slope, length · (slope - next slope), length²
        self._sums = np.zeros(4)
        super()._setup_model()

    def _update_target_kl(self, batch: EpisodeBatch) -> float:
        scaled = super()._update_target_kl(batch)
        assert scaled is not None
        assert self.target_kl is not None
        ratio = self.fraction * self._parabola_kl() / DEFAULT_KL
        return DEFAULT_KL * min(HIGHEST, max(LOWEST, ratio)) * scaled / self.target_kl

    def _parabola_kl(self) -> float:
        """Add the present rollout to the sums and return ½ (slope/curvature)²."""
        slope = self.records[-1]["slope"]
        if math.isfinite(slope):
            self._sums *= MEMORY
            self._sums[:2] += 1.0, slope
        if len(self.records) > 1:
            last = self.records[-2]
            drop, length = last["slope"] - last["next_slope"], last["length"]
            if math.isfinite(length * drop):
                self._sums[2:] += length * drop, length**2
        count, slopes, drops, squares = self._sums
        if count == 0.0 or squares == 0.0:
            return DEFAULT_KL / self.fraction  # nothing is known
        return parabola_kl(slopes / count, drops / squares)


def jobs(seeds: int) -> list[Row]:
    """Return one job per training run."""
    return [
        {"env": env, "arm": arm, "seed": seed}
        for arm, env, seed in itertools.product(FRACTIONS, ENVS, range(seeds))
    ]


def measure(env: str, arm: str, seed: int) -> list[Row]:
    """Train once."""
    model = make_model(env, seed, AutoKL, target_kl=DEFAULT_KL)
    assert isinstance(model, AutoKL)
    model.fraction = FRACTIONS[arm]
    returns = Returns(BUDGET)
    model.learn(BUDGET, callback=returns)
    targets = [record["target_kl"] for record in model.records]
    return [returns.summary() | {"median_target_kl": float(np.median(targets))}]


def entry_rows(env: str, seeds: Sequence[int]) -> list[Row]:
    """Return the rows of the entry's runs, from the first ``BUDGET`` steps of their curves."""
    curves = read_curves(RESULTS)
    rows = []
    for seed in seeds:
        chosen = (curves.algo == "CRPN") & (curves.env == env) & (curves.setting == "")
        curve = curves[chosen & (curves.seed == seed) & (curves.steps <= BUDGET)]
        late = curve[curve.steps > 0.8 * BUDGET]
        rows.append(
            {"env": env, "arm": "entry", "seed": seed}
            | {"mean_return": curve["return"].mean(), "late_return": late["return"].mean()}
            | {"median_target_kl": float(resolve("CRPN", env, {})[1].get("target_kl", DEFAULT_KL))}
        )
    return rows


def table(rows: pd.DataFrame) -> str:
    """Return a Markdown table: means over seeds with intervals."""
    body = []
    for (env, arm), group in rows.groupby(["env", "arm"], sort=False):
        means = [estimate(interval(group[key]), ".0f") for key in ("mean_return", "late_return")]
        body.append([env, arm, len(group), *means, f"{group.median_target_kl.median():.3f}"])
    head = ["task", "target_kl", "seeds", "mean return", "of the last fifth", "median target"]
    return markdown(head, body)


def draw(rows: pd.DataFrame) -> Figure:
    """Draw the mean returns, a panel a task; print the table."""
    envs = [env for env in ENVS if env in set(rows.env)]
    entries = [pd.DataFrame(entry_rows(env, list(rows[rows.env == env].seed))) for env in envs]
    rows = pd.concat([*entries, rows], ignore_index=True).sort_values("env", kind="stable")
    print(table(rows))
    figure, axes = plt.subplots(1, len(envs), figsize=(3 * len(envs), 2.8), layout="constrained")
    for axis, env in zip(np.atleast_1d(axes), envs, strict=True):
        _draw_means(axis, rows[rows.env == env])
        axis.set_title(env, fontsize=9)
    np.atleast_1d(axes)[0].set_ylabel("mean return over training")
    return figure


def _draw_means(axis: Axes, rows: pd.DataFrame) -> None:
    arms = list(rows.arm.unique())
    for position, (colour, arm) in enumerate(zip(PALETTE, arms, strict=False)):
        values = rows[rows.arm == arm].mean_return
        mean, low, high = interval(values)
        axis.errorbar(position, mean, [[mean - low], [high - mean]], fmt="o", color=colour)
        axis.plot(np.full(len(values), position), values, ".", ms=3, color=colour, alpha=0.4)
    axis.set_xticks(range(len(arms)), arms, fontsize=7)


STUDY = Study("auto_kl", jobs, measure, draw, seeds=5)

if __name__ == "__main__":
    STUDY.main(str(__doc__))
