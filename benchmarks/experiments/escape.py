"""The number of episodes to leave a strict saddle.

    python -m benchmarks.experiments.escape --jobs 2

The coordination MDP (γ = 1), from its exact saddle θ = 0; from a random direction at distance 1e-3;
and from the saddle with noisy rewards, of standard deviation 3 (without noise every single episode
tells the Hessian at the saddle exactly). An algorithm has left the saddle when the exact expected
return, evaluated after each update, exceeds 0.5; runs are cut after 20,000 episodes. All simulate
the same number of whole episodes an update. The paper's α is 3 L_H and REINFORCE's step 1/L, with
the Lipschitz constants of this very J; the others keep their default arguments. Then the one
argument that sets the length of each algorithm's steps is varied over a wide range, and so is the
number of episodes an update.
"""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.common.figures import PALETTE
from benchmarks.common.intervals import interval, ratio_of_medians
from benchmarks.common.markdown import estimate, markdown
from benchmarks.common.table import Row
from benchmarks.exact import coordination_mdp
from benchmarks.experiments.learners import make_learner, run_until
from benchmarks.experiments.study import Study

BATCH, CAP, LEFT = 64, 20_000, 0.5
STARTS = {
    "saddle": "exactly on the saddle",
    "nearby": "at distance $10^{-3}$",
    "noisy": "on the saddle, noisy rewards",
}
DISTANCE, NOISE = 1e-3, 3.0
# sup ‖∇²J‖ = 3/2, at the saddle; sup ‖∇³J‖ = 2.65, on a grid over both logit differences
L, L_H = 1.5, 2.65
# The argument that determines the step length: the value used, then others
KNOBS = {
    "CRPN, paper": ("alpha", (3 * L_H, 0.3 * L_H, L_H, 10 * L_H)),
    "ACRPN, paper": ("alpha", (3 * L_H, 0.3 * L_H, L_H, 10 * L_H)),
    "CRPN": ("target_kl", (0.02, 0.005, 0.1, 0.5)),
    "ACRPN": ("target_kl", (0.02, 0.005, 0.1, 0.5)),
    "REINFORCE": ("actor_learning_rate", (round(1 / L, 3), 0.2, 2.0, 6.0)),
    "A2C": ("learning_rate", (7e-4, 7e-3, 7e-2, 7e-1)),
    "PPO": ("learning_rate", (3e-4, 3e-3, 3e-2, 3e-1)),
    "TRPO": ("target_kl", (0.01, 0.04, 0.1, 0.5)),
}
BATCHES = (8, 16, 32, 128, 256)
SWEPT = ("CRPN, paper", "CRPN", "REINFORCE", "TRPO")
COLOURS = dict(zip(KNOBS, PALETTE, strict=True))


def jobs(seeds: int) -> list[Row]:
    """Return what to run."""
    kinds = []
    for algorithm, (_, values) in KNOBS.items():
        kinds += [(algorithm, values[0], BATCH, start) for start in STARTS]
        kinds += [(algorithm, value, BATCH, "saddle") for value in values[1:]]
        if algorithm in SWEPT:
            kinds += [(algorithm, values[0], b, s) for b in BATCHES for s in ("saddle", "noisy")]
    keys = ("algorithm", "knob", "batch", "start", "seed")
    return [dict(zip(keys, (*kind, seed), strict=True)) for seed in range(seeds) for kind in kinds]


def measure(algorithm: str, knob: float, batch: int, start: str, seed: int) -> list[Row]:
    """Run one algorithm until it has left the saddle."""
    mdp = coordination_mdp(noise=NOISE if start == "noisy" else 0.0)
    generator = torch.Generator().manual_seed(seed)
    direction = torch.randn(mdp.n_parameters, dtype=torch.float64, generator=generator)
    theta = (DISTANCE if start == "nearby" else 0.0) * direction / direction.norm()
    model = make_learner(algorithm, mdp, batch, theta, seed, **{KNOBS[algorithm][0]: knob})
    until = run_until(model, lambda theta: -mdp.cost(theta).item() > LEFT, CAP // batch)
    episodes = until.n_updates * batch
    return [{"episodes": episodes, "escaped": int(until.met), "updates": until.n_updates}]


def draw(rows: pd.DataFrame) -> Figure:
    """Draw the three panels and print the medians and ratios."""
    print(table(rows))
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained")
    _draw_starts(axes[0], rows)
    _draw_knobs(axes[1], rows)
    _draw_batches(axes[2], rows)
    return figure


def _select(
    rows: pd.DataFrame,
    algorithm: str,
    *,
    start: str = "saddle",
    knob: float | None = None,
    batch: int = BATCH,
) -> pd.DataFrame:
    knob = KNOBS[algorithm][1][0] if knob is None else knob
    rows = rows[(rows.algorithm == algorithm) & (rows.start == start) & (rows.batch == batch)]
    return rows[np.isclose(rows.knob, knob)]


def table(rows: pd.DataFrame) -> str:
    """Return a Markdown table of the runs with the values used."""
    body = []
    for start in STARTS:
        unit = _select(rows, "CRPN, paper", start=start).episodes
        for algorithm in KNOBS:
            runs = _select(rows, algorithm, start=start)
            middle = estimate(interval(runs.episodes, statistic=np.median), ".0f")
            ratio = estimate(interval(runs.episodes, unit, statistic=ratio_of_medians), ".1f")
            bound = "" if runs.escaped.all() else "≥ "
            escaped = f"{runs.escaped.sum()} of {len(runs)}"
            body.append([start, algorithm, bound + middle, escaped, bound + ratio])
    head = ["start", "algorithm", "median episodes", "escaped", "episodes / CRPN, paper"]
    return markdown(head, body)


def _draw_starts(axis: Axes, rows: pd.DataFrame) -> None:
    rng = np.random.default_rng(0)
    for (start, label), marker, shift in zip(
        STARTS.items(), "oD^", (-0.27, 0.0, 0.27), strict=True
    ):
        for place, algorithm in enumerate(KNOBS):
            runs = _select(rows, algorithm, start=start)
            # a small horizontal offset separates points of equal batch size
            height = place + shift + rng.uniform(-0.08, 0.08, len(runs))
            x = runs.episodes * np.exp(rng.uniform(-0.05, 0.05, len(runs)))
            colour = COLOURS[algorithm]
            face = np.where(runs.escaped == 1, colour, "none")
            axis.scatter(x, height, s=8, marker=marker, c=face, edgecolors=colour, lw=0.6)
            middle = runs.episodes.median()
            axis.plot([middle] * 2, [place + shift - 0.12, place + shift + 0.12], "k", lw=1.2)
        axis.plot([], [], marker, color="0.4", ms=4, label=label)
    axis.plot([], [], "o", mfc="none", color="0.4", ms=4, label="cut")
    axis.set(xscale="log", xlabel="episodes to leave the saddle", yticks=range(len(KNOBS)))
    axis.set_yticklabels(KNOBS)
    axis.invert_yaxis()
    axis.legend(loc="upper right", fontsize=7)
    axis.set_title(f"{BATCH} episodes an update", fontsize=9)


def _draw_knobs(axis: Axes, rows: pd.DataFrame) -> None:
    for algorithm, (name, values) in KNOBS.items():
        power = -1 if name == "alpha" else 1  # to the right, steps grow longer
        points = sorted(
            ((value / values[0]) ** power, _select(rows, algorithm, knob=value).episodes.median())
            for value in values
        )
        style = "s--" if algorithm.startswith("ACRPN") else "o-"
        label = f"{algorithm}: {'1/' if power < 0 else ''}{name}"
        axis.plot(*zip(*points, strict=True), style, ms=3, color=COLOURS[algorithm], label=label)
    axis.set(xscale="log", yscale="log", xlabel="step length, relative to the left panel's")
    axis.set_ylabel("median episodes to leave")
    axis.axhline(BATCH, color="0.6", lw=0.8, ls=":")
    axis.legend(fontsize=6)
    axis.set_title("length of the steps", fontsize=9)


def _draw_batches(axis: Axes, rows: pd.DataFrame) -> None:
    sizes = np.array(sorted((*BATCHES, BATCH)))
    for start, style in (("saddle", "o-"), ("noisy", "^--")):
        for algorithm in SWEPT:
            bands = [
                interval(
                    _select(rows, algorithm, start=start, batch=b).episodes, statistic=np.median
                )
                for b in sizes
            ]
            middle, low, high = np.array(bands).T
            label = algorithm if start == "saddle" else None
            axis.plot(sizes, middle, style, ms=3, color=COLOURS[algorithm], label=label)
            axis.fill_between(sizes, low, high, color=COLOURS[algorithm], alpha=0.2, lw=0)
    axis.plot([], [], "^--", ms=3, color="0.4", label="noisy rewards")
    axis.plot(sizes, sizes, ":", color="0.6", lw=0.8, label="one update")
    axis.set(xscale="log", yscale="log", xlabel="episodes an update")
    axis.set_ylabel("median episodes to leave")
    axis.legend(fontsize=7)
    axis.set_title("size of the batch", fontsize=9)


STUDY = Study("escape", jobs, measure, draw, seeds=20)

if __name__ == "__main__":
    STUDY.main(str(__doc__))
