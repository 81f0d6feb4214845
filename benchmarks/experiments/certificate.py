"""How often a certificate is right, on MDPs whose ‖∇J‖ and λ_min(∇²J) are known.

    python -m benchmarks.experiments.certificate

Policies that are, by exact derivatives, ε-second-order stationary, saddles, or not stationary, some
clearly so and some narrowly; 20 certificates of each from each number of episodes. A certificate
may say "undecided"; that it says something false is to have a probability of at most 5 %.
"""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from scipy.stats import binomtest

from benchmarks.common.figures import PALETTE
from benchmarks.common.markdown import markdown
from benchmarks.common.table import Row
from benchmarks.exact import TabularMDP, coordination_mdp, random_mdp
from benchmarks.experiments.learners import make_learner
from benchmarks.experiments.study import Study
from sb3_crpn.sosp import certify_sosp

CONFIDENCE = 0.95
REPEATS = 10  # certificates a row
EPISODES = (20, 100, 500, 2000)
VERDICTS = {
    "sosp": PALETTE[2], "saddle": PALETTE[1], "not stationary": PALETTE[0], "undecided": "#dddddd"
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A policy, with thresholds relative to its exact derivatives.

    ``epsilon`` is ε; ``threshold`` is √(ρε).
    """

    mdp: TabularMDP
    theta: torch.Tensor
    epsilon: float
    threshold: float

    @property
    def rho(self) -> float:
        """ρ."""
        return self.threshold**2 / self.epsilon

    @property
    def truth(self) -> str:
        """The verdict of the exact derivatives."""
        if self.mdp.gradient(self.theta).norm() > self.epsilon:
            return "not stationary"
        return "sosp" if self.mdp.is_sosp(self.theta, self.epsilon, self.rho) else "saddle"


def _cases() -> dict[str, Case]:
    coordination = coordination_mdp(noise=1.0)
    saddle = torch.zeros(6, dtype=torch.float64)  # ∇J = 0, λ_min = -1.5
    solved = torch.tensor([-1.5, -1.5, 1.5, 1.5, 0.0, 0.0], dtype=torch.float64)
    slope = float(coordination.gradient(solved).norm())
    other = random_mdp(0)
    uniform = torch.zeros(other.n_parameters, dtype=torch.float64)
    steep = float(other.gradient(uniform).norm())
    bend = -float(torch.linalg.eigvalsh(other.hessian(uniform))[0])
    return {
        "saddle, clearly": Case(coordination, saddle, 0.3, 0.5),
        "saddle, narrowly": Case(coordination, saddle, 0.3, 1.3),
        "sosp, narrowly: curvature": Case(coordination, saddle, 0.3, 1.7),
        "sosp, clearly": Case(coordination, solved, 4 * slope, 1.0),
        "sosp, narrowly: gradient": Case(coordination, solved, 1.25 * slope, 1.0),
        "not stationary, narrowly": Case(coordination, solved, 0.8 * slope, 1.0),
        "not stationary, clearly": Case(other, uniform, 0.25 * steep, 4 * bend),
        "saddle at a slope, narrowly": Case(other, uniform, 1.25 * steep, 0.8 * bend),
    }


CASES = _cases()


def jobs(seeds: int) -> list[Row]:
    """Return what to run."""
    return [
        {"case": case, "episodes": episodes, "seed": seed}
        for seed in range(seeds)
        for case in CASES
        for episodes in EPISODES
    ]


def measure(case: str, episodes: int, seed: int) -> list[Row]:
    """Count the verdicts of ``REPEATS`` certificates."""
    chosen = CASES[case]
    model = make_learner("CRPN, paper", chosen.mdp, episodes, chosen.theta, seed)
    torch.nn.init.zeros_(model.policy.value_net.weight)  # no critic has been fitted
    model.get_env().seed(seed)
    reports = [
        certify_sosp(
            model,
            episodes,
            chosen.epsilon,
            chosen.rho,
            confidence=CONFIDENCE,
            seed=REPEATS * seed + repeat,
        )
        for repeat in range(REPEATS)
    ]
    verdicts = [report.verdict for report in reports]
    return [{"truth": chosen.truth} | {name: verdicts.count(name) for name in VERDICTS}]


def draw(rows: pd.DataFrame) -> Figure:
    """Draw the shares of the verdicts and print the error rates."""
    print(table(rows))
    figure, axes = plt.subplots(
        2, 4, figsize=(10, 4.2), sharex=True, sharey=True, layout="constrained"
    )
    for axis, case in zip(axes.flat, CASES, strict=True):
        counts = rows[rows.case == case].groupby("episodes")[list(VERDICTS)].sum()
        shares = counts.div(counts.sum(axis=1), axis=0)
        left = np.zeros(len(shares))
        truth = CASES[case].truth
        for verdict in sorted(VERDICTS, key=lambda name: (name != truth, name == "undecided")):
            colour, width = VERDICTS[verdict], shares[verdict].to_numpy()
            axis.bar(range(len(shares)), width, bottom=left, color=colour, width=0.8)
            left += width
        axis.set_xticks(range(len(shares)), shares.index)
        axis.set_title(f"truth: {case}", fontsize=8)
        axis.grid(visible=False)
    for axis in axes[:, 0]:
        axis.set_ylabel("share of certificates")
    for axis in axes[1]:
        axis.set_xlabel("episodes")
    handles = [plt.Rectangle((0, 0), 1, 1, color=colour) for colour in VERDICTS.values()]
    figure.legend(handles, VERDICTS, loc="outside lower center", ncols=4)
    return figure


def table(rows: pd.DataFrame) -> str:
    """Return a Markdown table of decided and false verdicts with exact binomial intervals."""
    body = []
    groups = [*rows.groupby(["case", "episodes"], sort=False), (("all", "all"), rows)]
    for (case, episodes), group in groups:
        n = group[list(VERDICTS)].to_numpy().sum()
        right = sum(row[row["truth"]] for _, row in group.iterrows())
        false_sosp = group[group.truth != "sosp"].sosp.sum()
        wrong = n - right - group.undecided.sum()
        possible = group[group.truth != "sosp"][list(VERDICTS)].to_numpy().sum()
        cells = [_share(right, n), _share(group.undecided.sum(), n), _share(wrong, n)]
        cells.append(_share(false_sosp, possible) if possible else "-")
        body.append([case, episodes, *cells])
    return markdown(["truth", "episodes", "right", "undecided", "false", "false sosp"], body)


def _share(count: int, n: int) -> str:
    band = binomtest(int(count), int(n)).proportion_ci(0.95)
    return f"{count / n:.1%} [{band.low:.1%}, {band.high:.1%}]"


STUDY = Study("certificate", jobs, measure, draw, seeds=2)

if __name__ == "__main__":
    STUDY.main(str(__doc__))
