"""What a rollout is worth once the policy has moved on: bias and variance of g and H.

    python -m benchmarks.experiments.reuse

Random MDPs of four states, episodes with random ends; γ = 1, λ = 0.95, κ = 0.9, the exact V.
A policy simulates episodes, and takes exact natural-gradient steps of a fixed KL divergence each.
After some steps the episodes are reused, with clipped traces, and weighted by

- ``later action``: the ratio of each step's action, in H of a pair's later one, as CRPN does;
- ``both actions``: in H the ratio of the earlier action too;
- ``visitation``: the later action's, and for the states that the old policy visited
  exp(clip(Σ_{j<i} log ρ_j, ±c)), of mean 1, for several c.

Errors are relative to the exact expectation of fresh episodes' estimates.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.optimize import brentq
from stable_baselines3.common.env_util import make_vec_env
from torch import Tensor

from benchmarks.common.figures import PALETTE
from benchmarks.common.markdown import markdown
from benchmarks.common.table import Row
from benchmarks.exact import (
    TabularEnv,
    TabularMDP,
    assign_actor,
    expected_causal_hessian,
    random_mdp,
)
from benchmarks.experiments.study import Study
from sb3_crpn import CRPN
from sb3_crpn.arrays import FloatArray, IntArray
from sb3_crpn.curvature import Causal
from sb3_crpn.episodes import EpisodeBatch, Replay
from sb3_crpn.episodes.batch import episode_scan, episode_starts
from sb3_crpn.episodes.replay import MAX_RATIO
from sb3_crpn.policy import values_and_log_probs

N_EPISODES = 5_000
PRACTICAL = 50  # episodes of an update
N_ENVS = 50
HORIZON = 60  # episodes end by themselves long before
KAPPA = 0.9
KLS = (0.005, 0.02, 0.08)
AGES = (1, 2, 3, 6)
CLIPS = (0.7, 1.5, float("inf"))
ARMS = ("later action", "both actions", *(f"visitation {clip:g}" for clip in CLIPS))


def jobs(seeds: int) -> list[Row]:
    """Return one job per MDP and step length."""
    return [{"seed": seed, "kl": kl} for seed, kl in itertools.product(range(seeds), KLS)]


def measure(seed: int, kl: float) -> list[Row]:
    """Return the errors after each number of steps."""
    mdp = random_mdp(seed, horizon=HORIZON, gamma=1.0, concentration=0.3, max_stop=0.4)
    generator = torch.Generator().manual_seed(seed)
    theta = torch.randn(mdp.n_parameters, dtype=torch.float64, generator=generator)
    model = CRPN(
        "MlpPolicy",
        make_vec_env(lambda: TabularEnv(mdp), N_ENVS, seed=seed),
        gamma=1.0,
        normalize_advantage=False,
        hessian_lambda=KAPPA,
        policy_kwargs={"net_arch": []},
        seed=seed,
        device="cpu",
    )
    assign(model, mdp, theta)
    episodes = model.estimate_curvature(N_EPISODES).gradient_batch
    rows = []
    for age in range(1, max(AGES) + 1):
        theta = theta + natural_step(mdp, theta, kl)
        if age in AGES:
            assign(model, mdp, theta)
            rows += [{"age": age} | row for row in errors(model, mdp, theta, episodes)]
    return rows


def assign(model: CRPN, mdp: TabularMDP, theta: Tensor) -> None:
    """Set the actor, and the critic to V of the first step: episodes end before the horizon."""
    assign_actor(model.policy, theta)
    with torch.no_grad():
        model.policy.value_net.weight.copy_(mdp.values(theta)[:1])
        model.policy.value_net.bias.zero_()


def natural_step(mdp: TabularMDP, theta: Tensor, kl: float) -> Tensor:
    """Return -t F⁻¹∇J with a mean KL divergence of ``kl`` over the states visited at θ, [d]."""
    visits = visitation(mdp, theta)

    def divergence(at: Tensor) -> Tensor:
        old = mdp.probabilities(theta)
        return visits @ (old * (old.log() - mdp.probabilities(at).log())).sum(1)

    fisher = torch.autograd.functional.hessian(divergence, theta)
    damped = fisher + 1e-3 * torch.eye(len(theta), dtype=torch.float64)
    direction = -torch.linalg.solve(damped, mdp.gradient(theta))
    length = brentq(lambda t: float(divergence(theta + t * direction)) - kl, 0.0, 1e3)
    return length * direction


def visitation(mdp: TabularMDP, theta: Tensor) -> Tensor:
    """Return the share of steps in each state, [S]."""
    kernel = torch.einsum("sa,sat->st", mdp.probabilities(theta), mdp.flow)
    reached, total = mdp.initial, torch.zeros_like(mdp.initial)
    for _ in range(mdp.horizon):
        total = total + reached
        reached = reached @ kernel
    return total / total.sum()


def errors(model: CRPN, mdp: TabularMDP, theta: Tensor, episodes: EpisodeBatch) -> list[Row]:
    """Return bias² and variance of one episode's g and H, by arm, in ‖∇J‖² and ‖E H‖²_F."""
    exact = (mdp.gradient(theta), expected_causal_hessian(mdp, theta, KAPPA))
    truths = [truth.flatten().numpy() for truth in exact]
    fresh = model.estimate_curvature(N_EPISODES).gradient_batch
    rows = [{"arm": "fresh", "ess": 1.0} | _moments(Derivatives(mdp, theta, fresh), truths)]
    reused, ratios = reweighted(model, episodes)
    ess = float(ratios.sum() ** 2 / (ratios**2).sum() / len(ratios))
    for arm in ARMS:
        batch = reused
        if arm.startswith("visitation"):
            weights = visitation_weights(ratios, reused.lengths, float(arm.split()[1]))
            batch = replace(reused, cost_advantages=weights * reused.cost_advantages)
        estimator = (
            PairRatios(np.minimum(ratios, MAX_RATIO)) if arm == "both actions" else Causal(KAPPA)
        )
        found = Derivatives(mdp, theta, batch, estimator)
        rows.append({"arm": arm, "ess": ess} | _moments(found, truths))
    return rows


def reweighted(model: CRPN, episodes: EpisodeBatch) -> tuple[EpisodeBatch, FloatArray]:
    """Return the episodes as CRPN reuses them, however unlike its policy has become, and ρ [T]."""
    replay = Replay(1, model.gamma, model.gae_lambda)
    values, log_probs = values_and_log_probs(model.policy, episodes.observations, episodes.actions)
    ratios = np.exp(log_probs.double().numpy() - episodes.log_probs)
    batch = replay._reweight(
        episodes,
        values.double().numpy(),
        np.zeros(episodes.n_episodes),
        ratios,
        baseline=True,
        normalize_advantage=False,
        discount_visitation=False,
    )
    return batch, ratios


def visitation_weights(
    ratios: FloatArray, lengths: IntArray, clip: float, decay: float = 1.0
) -> FloatArray:
    """Return exp(clip(Σ_{i<j} κ^{j-i} log ρ_i, ±c)), κ = ``decay``, divided by their mean, [T]."""
    logarithms = np.log(ratios)
    past = episode_scan(logarithms, decay, lengths) - logarithms
    weights: FloatArray = np.exp(np.clip(past, -clip, clip))
    return weights / weights.mean()


@dataclass(frozen=True, eq=False)
class PairRatios:
    """W_ij = κ^|i-j| ρ_min(i,j) A_max(i,j) for i ≠ j, W_ii = A_i.

    Attributes
    ----------
    ratios
        ρ_i, [T].
    """

    ratios: FloatArray

    def apply(self, cost_advantages: FloatArray, lengths: IntArray, u: FloatArray) -> FloatArray:
        """Return Wu, [T, k]."""
        A, ratios = cost_advantages[:, None], self.ratios[:, None]
        before, after = ratios * u, A * u
        past = episode_scan(before, KAPPA, lengths) - before
        future = episode_scan(after, KAPPA, lengths, reverse=True) - after
        product: FloatArray = A * (past + u) + ratios * future
        return product


class Derivatives:
    """Each episode's estimates of g [E, d] and H [E, d, d], from scores in closed form."""

    def __init__(
        self,
        mdp: TabularMDP,
        theta: Tensor,
        batch: EpisodeBatch,
        estimator: Causal | PairRatios | None = None,
    ) -> None:
        assert isinstance(batch.observations, Tensor)
        features = np.append(batch.observations.numpy(), np.ones((batch.n_steps, 1)), axis=1)
        observed = batch.observations.argmax(1)
        policy = mdp.probabilities(theta)[observed].numpy()  # state = observation
        A = batch.cost_advantages
        difference = np.eye(mdp.n_actions)[batch.actions.long().flatten().numpy()] - policy
        scores = self._parameters(difference[:, :, None] * features[:, None])
        covariance = policy[:, :, None] * (np.eye(mdp.n_actions) - policy[:, None])
        logits = np.einsum("tab,tf,tg->tafbg", covariance, features, features)
        d = mdp.n_parameters
        # rows, then columns of ∇²log π = -(diag π - ππᵀ) ⊗ φφᵀ in the order of θ
        half = self._parameters(logits.reshape(*logits.shape[:3], -1)).reshape(
            batch.n_steps, d, *logits.shape[3:]
        )
        curvature = self._parameters(np.moveaxis(half, 1, -1))
        weighted = (estimator or Causal(KAPPA)).apply(A, batch.lengths, scores)
        at = episode_starts(batch.lengths)
        self.gradients: FloatArray = np.add.reduceat(A[:, None] * scores, at)
        self.hessians: FloatArray = np.add.reduceat(
            scores[:, :, None] * weighted[:, None] - A[:, None, None] * curvature, at
        )

    @staticmethod
    def _parameters(array: FloatArray) -> FloatArray:
        """Return [T, A, O + 1, …] as [T, d, …]: the weight row by row, then the bias."""
        weight, bias = array[:, :, :-1], array[:, :, -1]
        shape = (len(array), -1, *array.shape[3:])
        return np.concatenate([weight.reshape(shape), bias.reshape(shape)], axis=1)


def _moments(derivatives: Derivatives, truths: list[FloatArray]) -> dict[str, float]:
    found = {}
    for name, each, truth in zip("gH", vars(derivatives).values(), truths, strict=True):
        each = each.reshape(len(each), -1)
        variance = float(each.var(0, ddof=1).sum())
        bias = float(((each.mean(0) - truth) ** 2).sum()) - variance / len(each)
        scale = float((truth**2).sum())
        found |= {f"bias_{name}": bias / scale, f"variance_{name}": variance / scale}
    return found


def summary(rows: pd.DataFrame) -> pd.DataFrame:
    """Return √bias² and the error of ``PRACTICAL`` episodes in that of fresh ones, over MDPs."""
    fresh = rows[rows.arm == "fresh"].set_index(["seed", "kl", "age"])
    rows = rows.join(fresh, on=["seed", "kl", "age"], rsuffix="_fresh")
    for name in "gH":
        rows[f"bias of {name}"] = rows[f"bias_{name}"].clip(lower=0.0) ** 0.5
        error = rows[f"bias_{name}"] + rows[f"variance_{name}"] / PRACTICAL
        rows[f"error of {name}"] = error / (rows[f"variance_{name}_fresh"] / PRACTICAL)
    columns = [f"{what} of {name}" for what in ("bias", "error") for name in "gH"]
    return rows.groupby(["kl", "age", "arm"], sort=False)[[*columns, "ess"]].median()


def table(rows: pd.DataFrame) -> str:
    """Return a Markdown table: medians over MDPs, bias of g and H, then errors, an arm a column."""
    found = summary(rows)
    body = []
    for (kl, age), _ in found.groupby(level=["kl", "age"]):
        of_arm = found.loc[(kl, age)]
        cells = [
            f"{of_arm.loc[arm, 'bias of g']:.2f}, {of_arm.loc[arm, 'bias of H']:.2f}; "
            f"{of_arm.loc[arm, 'error of g']:.1f}, {of_arm.loc[arm, 'error of H']:.1f}"
            for arm in ARMS
        ]
        body.append([f"{kl:g}", age, f"{of_arm.ess.min():.2f}", *cells])
    return markdown(["KL a step", "steps", "effective size", *ARMS], body)


def draw(rows: pd.DataFrame) -> Figure:
    """Draw the biases over the age; print the table."""
    print(table(rows))
    figure, axes = plt.subplots(
        2, len(KLS), figsize=(9, 5), sharey="row", sharex=True, layout="constrained"
    )
    found = summary(rows)
    for (row, name), (column, kl) in itertools.product(enumerate("gH"), enumerate(KLS)):
        _draw(axes[row, column], found.loc[kl][f"bias of {name}"])
        axes[row, 0].set_ylabel(f"bias of {name}")
        axes[0, column].set_title(f"KL divergence {kl:g} a step", fontsize=9)
        axes[1, column].set_xlabel("steps since the episodes")
    axes[0, 0].legend(fontsize=7)
    return figure


def _draw(axis: Axes, biases: pd.Series) -> None:
    for colour, arm in zip(PALETTE, ARMS, strict=False):
        curve = biases.xs(arm, level="arm")
        axis.plot(curve.index, curve, "o-", ms=3, color=colour, label=arm)
    axis.set_yscale("log")


STUDY = Study("reuse", jobs, measure, draw, seeds=6)

if __name__ == "__main__":
    STUDY.main(str(__doc__))
