"""What one update is made of: its episodes, its cubic model, and what is told of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_crpn.algorithm.rollouts import TrainingRollouts
from sb3_crpn.algorithm.settings import PolicyNewtonSettings
from sb3_crpn.algorithm.solvers import SubproblemSolver
from sb3_crpn.algorithm.step import PolicyStep
from sb3_crpn.curvature import (
    METRICS,
    Constant,
    CurvatureEstimate,
    Euclidean,
    FullModel,
    LocalModel,
    resolve_shrinkage,
    subspace_model,
)
from sb3_crpn.episodes import EpisodeBatch, concatenate

# Dimension of the Krylov space when the step's length is set by the KL divergence: the number of
# conjugate-gradient iterations of Schulman et al., Trust region policy optimization, ICML 2015,
# appendix C, whose step H = 0 then reproduces.
KRYLOV_DIM = 10


@dataclass(frozen=True, eq=False)
class UpdateData:
    """The episodes that an update learns from.

    Attributes
    ----------
    fresh
        The rollout just collected.
    earlier
        The reused rollouts before it, importance-weighted.
    """

    fresh: EpisodeBatch
    earlier: list[EpisodeBatch]

    @cached_property
    def joined(self) -> EpisodeBatch:
        """All episodes, the fresh ones first."""
        return concatenate([self.fresh, *self.earlier])

    def draw(
        self, m: int | None, b: int | None, rng: np.random.Generator
    ) -> tuple[EpisodeBatch, EpisodeBatch | None, EpisodeBatch | None]:
        """Return the batches of g, H and F, the last two ``None`` where they are that of g.

        m and b of the fresh episodes (``None``: all) are drawn without replacement, and the
        earlier ones join them. F, of which no return makes noise, is the m episodes' alone.
        """
        fresh, n_simulated = self.fresh, self.fresh.total_episodes

        def chosen(number: int) -> EpisodeBatch:
            episodes = rng.choice(fresh.n_episodes, fresh.share(number), replace=False)
            return fresh.take(episodes)

        drawn = fresh if m is None or m >= n_simulated else chosen(m)
        hessian_batch = None
        if b is not None and b < n_simulated:
            hessian_batch = concatenate([chosen(b), *self.earlier])
        elif b is not None and drawn is not fresh:
            hessian_batch = self.joined
        batch = self.joined if drawn is fresh else concatenate([drawn, *self.earlier])
        return batch, hessian_batch, drawn if self.earlier else None


def local_model(
    settings: PolicyNewtonSettings,
    estimate: CurvatureEstimate,
    solver: SubproblemSolver,
    target_kl: float | None,
) -> LocalModel:
    """Build the cubic model, on a subspace unless the paper's full space is asked for.

    Trials of steps end the products of the full space: with ``target_kl`` there are several.
    """
    metric = METRICS.resolve(settings.metric, settings)
    shrinkage = resolve_shrinkage(settings.hessian_shrinkage, settings)
    if solver.needs_matrix(len(estimate.gradient)):
        return subspace_model(estimate, metric, shrinkage)
    unrestricted = settings.krylov_dim is None and target_kl is None
    if unrestricted and isinstance(metric, Euclidean) and isinstance(shrinkage, Constant):
        return FullModel(estimate, shrinkage.value)
    dim = KRYLOV_DIM if settings.krylov_dim is None else settings.krylov_dim
    return subspace_model(estimate, metric, shrinkage, dim)


def step_statistics(
    estimate: CurvatureEstimate, model: LocalModel, step: PolicyStep, accepted: bool
) -> dict[str, Any]:
    """Return what is known of the step; one that was not accepted has had no effect."""
    cubic, batch = step.cubic, estimate.gradient_batch
    change = step.evaluation.surrogate_change if accepted else 0.0
    mean_cost = batch.moments(batch.cost_advantages)[0]
    return {
        "gradient_norm": float(estimate.gradient.norm()),
        "gradient_noise": estimate.gradient_noise,
        "alpha": step.alpha,
        "multiplier": cubic.multiplier,
        "predicted_decrease": cubic.predicted_decrease,
        "step_norm": float(step.step.norm()) if accepted else 0.0,
        "kl_divergence": step.kl if accepted else 0.0,
        "surrogate_change": change,
        "policy_objective": -mean_cost - change * batch.total_size / batch.total_steps,
        "accepted": accepted,
        "certified": cubic.certified,
        "solver_status": cubic.status,
        # the ranks' solves agree to rounding: the end of training is rank 0's decision
        "at_sosp": bool(batch.agreed(torch.tensor(cubic.at_sosp))),
        "lambda_min": model.lambda_min(cubic),
        "confirmed_lambda_min": model.confirmed_lambda_min,
        "hessian_vector_products": model.products(cubic),
        "hessian_shrinkage": model.shrinkage,
    }


def rollout_statistics(
    data: UpdateData, rollouts: TrainingRollouts, policy: ActorCriticPolicy
) -> dict[str, Any]:
    """Return what is known of the rollout, and of the policy that it was learnt from."""
    log_std = getattr(policy, "log_std", None)
    return {
        "mean_reward": rollouts.mean_reward,
        "n_episodes": data.fresh.total_episodes,
        "n_reused_rollouts": len(data.earlier),
        "used_timesteps_fraction": rollouts.used_fraction,
        "explained_variance": _explained_variance(data.fresh),
        "std": None if log_std is None else torch.exp(log_std).mean().item(),
    }


def _explained_variance(batch: EpisodeBatch) -> float:
    """Return 1 - Var[R - V] / Var[R] over the steps of all ranks; nan where Var[R] = 0."""
    variance = batch.moments(batch.returns)[1]
    unexplained = batch.moments(batch.returns - batch.values)[1]
    return 1.0 - unexplained / variance if variance else float("nan")
