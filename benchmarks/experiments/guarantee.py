"""The distance of Algorithm 1's result to its guarantee, with printed and derived recipes.

    python -m benchmarks.experiments.guarantee

Two problems for which the recipes are affordable: a two-armed bandit (H = 1), and the coordination
MDP of the exact test bed from its strict saddle (H = 2). K, G, L_1, L_2 and H are those of all such
problems; J(θ_0) - J* = 1 is the problem's own. Of m episodes of so few possible trajectories only
the number of each matters. It is drawn from its multinomial distribution: an update costs the same
whatever m and b are, and is distributed as Algorithm 1's.

θ_R is drawn uniformly from θ_1, …, θ_N; ‖∇J(θ_R)‖ and λ_min(∇²J(θ_R)) are exact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure

from benchmarks.common.figures import PALETTE
from benchmarks.common.markdown import markdown
from benchmarks.common.table import Row
from benchmarks.experiments.study import Study
from sb3_crpn.arrays import FloatArray
from sb3_crpn.cubic import solve_dense
from sb3_crpn.theory import (
    Constants,
    expectation_recipe,
    high_probability_recipe,
    printed_expectation_recipe,
    printed_high_probability_recipe,
    softmax_linear,
)
from sb3_crpn.theory.recipes import Recipe

GRADIENT_BOUND = 0.5
FAILURE_PROBABILITY = 0.05
RECIPES: dict[str, Callable[[Constants], Recipe]] = {
    "printed, expectation": lambda c: printed_expectation_recipe(c, GRADIENT_BOUND / 25, 1.0),
    "derived, expectation": lambda c: expectation_recipe(c, GRADIENT_BOUND, 1.0),
    "printed, high probability": lambda c: printed_high_probability_recipe(
        c, GRADIENT_BOUND / 25, FAILURE_PROBABILITY, 1.0
    ),
    "derived, high probability": lambda c: high_probability_recipe(
        c, GRADIENT_BOUND, FAILURE_PROBABILITY, 1.0
    ),
}


@dataclass(frozen=True)
class Enumerated:
    """H steps of two actions, each step with an observation of its own; J(0) - J* = 1.

    θ is that of :class:`~benchmarks.exact.TabularMDP`: W [2, H] row by row, then b [2].

    Attributes
    ----------
    rewards
        The rewards [H] of each sequence of actions, in the order of ``trajectories``.
    """

    rewards: FloatArray

    @property
    def horizon(self) -> int:
        """H."""
        return self.rewards.shape[1]

    @property
    def d(self) -> int:
        """The length of θ."""
        return 2 * (self.horizon + 1)

    @property
    def trajectories(self) -> FloatArray:
        """All sequences of actions, [2^H, H]."""
        return np.array(list(product(range(2), repeat=self.horizon)))

    def estimates(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return p(τ; θ) [T], g(θ; τ) [T, d] and the symmetric part of H(θ; τ) [T, d, d]."""
        H = self.horizon
        features = np.hstack([np.eye(H), np.ones((H, 1))])  # one-hot observation and bias
        logits = theta[: 2 * H].reshape(2, H).T + theta[2 * H :]
        policy = np.exp(logits - logits.max(1, keepdims=True))
        policy /= policy.sum(1, keepdims=True)
        chosen = np.eye(2)[self.trajectories]  # [T, H, 2]
        scores = np.einsum("tha,hf->thaf", chosen - policy, features)
        scores = np.concatenate([scores[..., :H].reshape(*scores.shape[:2], -1), scores[..., H]], 2)
        psi = -self.rewards[:, ::-1].cumsum(1)[:, ::-1]
        g = np.einsum("th,thi->ti", psi, scores)
        outer = g[:, :, None] * scores.sum(1)[:, None, :]
        # ∇²log π = -E_a[σ σᵀ] at each step, for every action
        each = np.einsum("ab,hf->habf", np.eye(2), features)  # e_a ⊗ φ_h
        each = np.concatenate([each[..., :H].reshape(H, 2, -1), each[..., H]], 2)
        centred = each - np.einsum("ha,hai->hi", policy, each)[:, None]
        curvature = -np.einsum("ha,hai,haj->hij", policy, centred, centred)
        hessians = (outer + outer.transpose(0, 2, 1)) / 2 + np.einsum("th,hij->tij", psi, curvature)
        return np.prod(np.sum(chosen * policy, 2), 1), g, hessians


PROBLEMS = {
    "bandit": Enumerated(np.array([[1.0], [-1.0]])),
    "coordination": Enumerated(np.array([[0, 1], [0, -1], [0, -1], [0, 1]], dtype=float)),
}


def jobs(seeds: int) -> list[Row]:
    """Return one job per run, those of few updates first."""
    runs = [
        {"problem": problem, "recipe": recipe, "seed": seed}
        for seed in range(seeds)
        for recipe in RECIPES
        for problem in PROBLEMS
    ]
    return sorted(runs, key=lambda run: (run["recipe"].split(",")[0], run["problem"], run["seed"]))


def measure(problem: str, recipe: str, seed: int, n_updates: int | None = None) -> list[Row]:
    """Run Algorithm 1 with the recipe's α, m, b and N."""
    chosen, rng = PROBLEMS[problem], np.random.default_rng(seed)
    plan = RECIPES[recipe](Constants(1.0, softmax_linear(1.0), chosen.horizon, chosen.d))
    n_updates = plan.n_updates if n_updates is None else n_updates
    m, b = plan.kwargs["n_episodes"], plan.kwargs["n_hessian_episodes"]
    found = np.empty((n_updates + 1, 2))  # ‖∇J‖ and -λ_min at θ_0, …, θ_N
    theta = np.zeros(chosen.d)
    for k in range(n_updates + 1):
        p, g, H = chosen.estimates(theta)
        exact = p @ g, np.einsum("t,tij->ij", p, H)
        found[k] = np.linalg.norm(exact[0]), -np.linalg.eigvalsh(exact[1])[0]
        if k < n_updates:
            g_k, H_k = _batch_means(rng, p, g, H, m, b)
            theta = theta + solve_dense(g_k, H_k, plan.kwargs["alpha"]).step.numpy()
    R = rng.integers(1, n_updates + 1)
    inside = (found <= [plan.gradient_bound, plan.curvature_bound]).all(1)
    return [
        {
            "n_updates": n_updates,
            "m": m,
            "b": b,
            "gradient_bound": plan.gradient_bound,
            "curvature_bound": plan.curvature_bound,
            "gradient_R": float(found[R, 0]),
            "curvature_R": float(found[R, 1]),
            "gradient_mean": float(found[1:, 0].mean()),
            "curvature_mean": float(found[1:, 1].mean()),
            "first_inside": int(np.argmax(inside)) if inside.any() else -1,
            "share_inside": float(inside[1:].mean()),
        }
    ]


def _batch_means(
    rng: np.random.Generator, p: FloatArray, g: FloatArray, H: FloatArray, m: int, b: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return ḡ of m and H̄ of b of max(m, b) episodes; the smaller batch is part of the larger."""
    small = rng.multinomial(min(m, b), p)
    large = small + rng.multinomial(max(m, b) - min(m, b), p)
    of_g, of_H = (small, large) if m < b else (large, small)
    return torch.from_numpy(of_g @ g / m), torch.from_numpy(np.einsum("t,tij->ij", of_H, H) / b)


def draw(rows: pd.DataFrame) -> Figure:
    """Draw the norms at θ_R relative to their bounds, and print the table."""
    print(table(rows))
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained", sharey=True)
    for axis, (title, name) in zip(
        axes, {"‖∇J(θ_R)‖": "gradient", "-λ_min(∇²J(θ_R))": "curvature"}.items(), strict=True
    ):
        for offset, (problem, group) in enumerate(rows.groupby("problem", sort=False)):
            share = group[f"{name}_R"] / group[f"{name}_bound"]
            heights = group.recipe.map(list(RECIPES).index) + 0.2 * offset
            axis.plot(share, heights, "o", ms=4, color=PALETTE[offset], label=problem)
        axis.axvline(1.0, color="0.4", lw=0.8, ls=":")
        axis.set(xlabel=f"{title} / its bound", xlim=(-0.1, 1.05))
        axis.set_yticks(range(len(RECIPES)), RECIPES)
    axes[0].legend(fontsize=7)
    return figure


def table(rows: pd.DataFrame) -> str:
    """Return a Markdown table, means over seeds."""
    head = ["problem", "recipe", "N", "m", "b", "‖∇J(θ_R)‖ ≤", "mean", "-λ_min(∇²J(θ_R)) ≤",
            "mean", "first inside", "share inside"]  # fmt: skip
    body = []
    for (problem, recipe), group in rows.groupby(["problem", "recipe"], sort=False):
        first = group.iloc[0]
        counts = [f"{int(first[name]):,}" for name in ("n_updates", "m", "b")]
        values = [
            f"{group[name].mean():.2g}"
            for name in ("gradient_bound", "gradient_mean", "curvature_bound", "curvature_mean")
        ]
        ends = [f"{group.first_inside.max()}", f"{group.share_inside.mean():.4f}"]
        body.append([problem, recipe, *counts, *values, *ends])
    return markdown(head, body)


STUDY = Study("guarantee", jobs, measure, draw, seeds=2)

if __name__ == "__main__":
    STUDY.main(str(__doc__))
