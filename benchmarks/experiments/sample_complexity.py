"""The number of episodes to an ε-second-order stationary point, as a function of ε.

    python -m benchmarks.experiments.sample_complexity

An ε-SOSP has ‖∇J‖ ≤ ε and λ_min(∇²J) ≥ -√(L_H ε); whether θ is one is decided after each update by
the exact derivatives, on which no episode is spent.

Batches scale as the theory has it, m = 8/ε² episodes for the gradient and b = 8/ε for the Hessian,
with a practical constant: one episode's gradient has a variance of 2 at the saddle of the
coordination MDP, so that the error of g is ε/2, where the provable recipe asks for (3/64) ε and
bounds that variance by its worst case. CRPN has the settings of PAPER and the recipe's α = 3 L_H;
REINFORCE steps by 1/L from m episodes. Both constants are those of the very problem.

The same steps with the exact gradient and Hessian in place of estimates, m episodes counted for
each, show where the slopes tend to for ε beyond reach of simulation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.common.figures import PALETTE
from benchmarks.common.intervals import Estimate, interval
from benchmarks.common.markdown import estimate, markdown
from benchmarks.common.table import Row
from benchmarks.exact import TabularMDP, coordination_mdp, random_mdp
from benchmarks.experiments.learners import make_learner, run_until
from benchmarks.experiments.study import Study
from sb3_crpn.cubic import solve_dense

BATCH_CONSTANT = 8
MAX_UPDATES = 1000
EXACT_EPSILONS = (0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
# The exponent of each algorithm's theoretical bound on the episodes
BOUNDS = {"CRPN, paper": -3.5, "REINFORCE": -4.0}
COLOURS = dict(zip(BOUNDS, PALETTE, strict=False))


@dataclass(frozen=True)
class Problem:
    """Where to start, with ``lipschitz_constants(mdp)``, and the ε to reach."""

    title: str
    mdp: TabularMDP
    theta: tuple[float, ...]
    L: float
    L_H: float
    epsilons: tuple[float, ...]

    @property
    def start(self) -> torch.Tensor:
        """θ_0, [d]."""
        return torch.tensor(self.theta, dtype=torch.float64)


PROBLEMS = {
    "plateau": Problem(
        "coordination, from the saddle: optimum at infinity",
        coordination_mdp(),
        theta=(0.0,) * 6,
        L=1.5,
        L_H=2.65,
        epsilons=(0.4, 0.2, 0.1, 0.05, 0.02),
    ),
    # Four states with one observation: the optimal policy is stochastic, p = (0.683, 0.317)
    "interior": Problem(
        "blind agent, from p = (0.05, 0.95): optimum inside",
        random_mdp(26, n_states=4, n_observations=1, horizon=4, gamma=1.0),
        theta=(0.0, 0.0, -1.5, 1.5),
        L=0.411,
        L_H=0.972,
        epsilons=(0.1, 0.05, 0.02, 0.01),
    ),
}


def jobs(seeds: int) -> list[Row]:
    """Return what to run, the cheap accuracies first."""
    runs = [
        {"problem": name, "algorithm": algorithm, "epsilon": epsilon, "seed": seed}
        for seed in range(seeds)
        for name, problem in PROBLEMS.items()
        for algorithm in BOUNDS
        for epsilon in problem.epsilons
    ]
    return sorted(runs, key=lambda run: -run["epsilon"])


def measure(problem: str, algorithm: str, epsilon: float, seed: int) -> list[Row]:
    """Train until θ is an ε-SOSP."""
    chosen = PROBLEMS[problem]
    m, b = math.ceil(BATCH_CONSTANT / epsilon**2), math.ceil(BATCH_CONSTANT / epsilon)
    arguments = (
        {"actor_learning_rate": 1 / chosen.L}
        if algorithm == "REINFORCE"
        else {"alpha": 3 * chosen.L_H, "n_episodes": m, "n_hessian_episodes": b}
    )
    model = make_learner(algorithm, chosen.mdp, max(m, b), chosen.start, seed, **arguments)
    until = run_until(
        model, lambda theta: chosen.mdp.is_sosp(theta, epsilon, chosen.L_H), MAX_UPDATES
    )
    if not until.met:
        raise RuntimeError(f"no {epsilon}-SOSP within {MAX_UPDATES} updates: {until.theta}")
    return [{"updates": until.n_updates, "episodes": until.n_updates * max(m, b)}]


def exact_updates(problem: Problem, algorithm: str) -> list[int]:
    """Return the number of noiseless updates to an ε-SOSP, for each of ``EXACT_EPSILONS``."""
    mdp, theta = problem.mdp, problem.start
    if not mdp.gradient(theta).any():  # gradient steps alone would stay on the saddle
        theta = theta + 1e-3 * torch.linalg.eigh(mdp.hessian(theta)).eigenvectors[:, 0]
    n_updates, counts = 0, []
    for epsilon in EXACT_EPSILONS:
        while not mdp.is_sosp(theta, epsilon, problem.L_H):
            gradient = mdp.gradient(theta)
            if algorithm == "REINFORCE":
                theta = theta - gradient / problem.L
            else:
                theta = theta + solve_dense(gradient, mdp.hessian(theta), 3 * problem.L_H).step
            n_updates += 1
        counts.append(n_updates)
    return counts


def draw(rows: pd.DataFrame) -> Figure:
    """Draw episodes against ε for each problem and print the slopes."""
    body = []
    figure, axes = plt.subplots(1, len(PROBLEMS), figsize=(9, 3.8), layout="constrained")
    for axis, (name, problem) in zip(axes, PROBLEMS.items(), strict=True):
        for algorithm, bound in BOUNDS.items():
            chosen = rows[(rows.problem == name) & (rows.algorithm == algorithm)]
            episodes = chosen.pivot_table(index="seed", columns="epsilon", values="episodes")
            slopes = interval_of_slopes(episodes)
            of_updates = interval_of_slopes(episodes * episodes.columns.to_numpy() ** 2)
            texts = [estimate(cell, ".2f") for cell in (slopes, of_updates)]
            exact = np.array(exact_updates(problem, algorithm)) / np.array(EXACT_EPSILONS) ** 2
            limit = np.polyfit(np.log(EXACT_EPSILONS[-3:]), np.log(exact[-3:]), 1)[0]
            body.append([name, algorithm, *texts, f"{limit:.2f}", f"{bound:g}"])
            axis.plot(EXACT_EPSILONS, BATCH_CONSTANT * exact, "--", lw=1, color=COLOURS[algorithm])
            _draw_fit(axis, algorithm, episodes, slopes, bound)
        axis.plot([], [], "--", lw=1, color="0.4", label="exact derivatives")
        axis.set(xscale="log", yscale="log", xlabel="ε", ylabel="episodes to an ε-SOSP")
        ticks = sorted({*problem.epsilons, *EXACT_EPSILONS})
        axis.set_xticks(ticks, [f"{epsilon:g}" for epsilon in ticks], fontsize=7)
        axis.minorticks_off()
        axis.set_title(problem.title, fontsize=9)
        axis.invert_xaxis()
        axis.legend(loc="lower right", fontsize=7)
    head = ["problem", "algorithm", "slope of episodes", "of updates", "exact, ε ≤ 0.005", "bound"]
    print(markdown(head, body))
    return figure


def interval_of_slopes(episodes: pd.DataFrame) -> Estimate:
    """Return the mean over seeds of the slope of log episodes [seeds, ε] in log ε, an interval."""
    x = np.log(episodes.columns.to_numpy(dtype=float))
    slopes = np.polyfit(x, np.log(episodes.to_numpy(dtype=float)).T, 1)[0]
    return interval(slopes, statistic=np.mean)


def _draw_fit(
    axis: Axes,
    algorithm: str,
    episodes: pd.DataFrame,
    slopes: Estimate,
    bound: float,
) -> None:
    epsilons: NDArray[np.float64] = episodes.columns.to_numpy(dtype=float)
    bands = np.array(
        [interval(episodes[epsilon], statistic=np.median) for epsilon in episodes.columns]
    )
    middle, low, high = bands.T
    colour = COLOURS[algorithm]
    label = f"{algorithm}: slope {estimate(slopes, '.2f')}"
    axis.plot(epsilons, middle, "o-", ms=4, color=colour, label=label)
    axis.fill_between(epsilons, low, high, color=colour, alpha=0.2, lw=0)
    reference = middle[-1] * (epsilons / epsilons[-1]) ** bound
    axis.plot(epsilons, reference, ":", color=colour, lw=1, label=f"bound: $ε^{{{bound:g}}}$")


STUDY = Study("sample_complexity", jobs, measure, draw, seeds=10)

if __name__ == "__main__":
    STUDY.main(str(__doc__))
