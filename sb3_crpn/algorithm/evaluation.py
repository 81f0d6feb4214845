"""Trying a step on the batch that it was computed from, and fitting its length to a KL target."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_crpn.curvature.derivatives import policy_distribution
from sb3_crpn.distributed import all_sum, broadcast
from sb3_crpn.episodes import EpisodeBatch
from sb3_crpn.parameters import ActorParameters
from sb3_crpn.policy import mean_divergence

# target_kl counts as met within 10 per cent (DESIGN section 5)
KL_TOLERANCE = 0.1
# Bisection on log α: 40 trials narrow 30 decades to the tolerance
MAX_TRIALS = 40
# Below it the cubic term is lost in the rounding of the others; far below it, α is 0
LOG_MIN_ALPHA = math.log(1e-30)


@dataclass(frozen=True)
class StepEvaluation:
    """What a step does on the batch.

    Attributes
    ----------
    kl
        Mean KL(π_θ ‖ π_θ+s) over the batch's states and the action's components.
    surrogate_change
        (1/m) Σ_i A_i (π_θ+s/π_θ - 1): negative is an improvement.
    """

    kl: float
    surrogate_change: float

    @property
    def finite(self) -> bool:
        """Whether the new policy is usable at all."""
        return math.isfinite(self.kl) and math.isfinite(self.surrogate_change)


class CandidateEvaluator:
    """Moves the actor to θ + s and back, one forward pass a trial.

    Parameters
    ----------
    policy, actor
        The policy at θ, in evaluation mode, and its actor's parameters.
    batch
        This rank's episodes on which steps are tried.
    max_steps
        Most steps in one forward pass, but at least one episode; ``None``: all.
    """

    def __init__(
        self,
        policy: ActorCriticPolicy,
        actor: ActorParameters,
        batch: EpisodeBatch,
        max_steps: int | None = None,
    ) -> None:
        self._policy, self._actor = policy, actor
        self._sizes = torch.tensor([batch.n_steps, batch.n_episodes], dtype=torch.float64)
        self._origin = actor.snapshot()
        self._vector = actor.vector
        self._pieces: list[tuple[EpisodeBatch, Distribution, torch.Tensor, torch.Tensor]] = []
        for piece in batch.chunks(max_steps):
            with torch.no_grad():
                reference = policy_distribution(policy, piece)
                log_prob = reference.log_prob(piece.actions)
            weights = log_prob.new_tensor(piece.cost_advantages)
            self._pieces.append((piece, reference, log_prob, weights))

    def evaluate(self, step: torch.Tensor) -> StepEvaluation:
        """Leave the actor at θ + ``step``, [d], of rank 0, and say what that does."""
        step = broadcast(step)
        if not torch.isfinite(step).all():
            return StepEvaluation(math.inf, math.inf)
        self._actor.load(self._actor.unflatten(self._vector + step))
        sums = torch.tensor(self._sums(), dtype=torch.float64)
        divergence, change, n_steps, n_episodes = all_sum(torch.cat([sums, self._sizes])).tolist()
        return StepEvaluation(divergence / n_steps, change / n_episodes)

    def _sums(self) -> tuple[float, float]:
        """Return Σ_i KL_i and Σ_i A_i (π_θ+s/π_θ - 1) over this rank's steps."""
        divergence = change = 0.0
        try:
            for piece, reference, log_prob, weights in self._pieces:
                with torch.no_grad():
                    distribution = policy_distribution(self._policy, piece)
                    log_ratio = distribution.log_prob(piece.actions) - log_prob
                    mean = mean_divergence(reference, distribution)
                divergence += piece.n_steps * mean.item()
                change += (weights * torch.expm1(log_ratio)).double().sum().item()
        except ValueError:  # torch's distributions refuse parameters that are not finite
            return math.inf, math.inf
        return divergence, change

    def restore(self) -> None:
        """Put the actor back to θ, bit for bit."""
        self._actor.load(self._origin)


def fit_alpha(kl: Callable[[float], float], alpha: float, target: float) -> float:
    """Return the smallest α whose step keeps the mean KL ≤ ``target``, met within 10 per cent.

    The KL falls with α, as 1/α where the cubic term dominates: the first guesses extrapolate that
    law on log α, bisection takes over once the target is bracketed. Where a smaller α no longer
    raises the KL (the Newton step lies inside the trust region), or the target is jumped over, the
    best α found is returned.

    Parameters
    ----------
    kl
        α ↦ mean KL of its step; not a number or infinite counts as too large.
    alpha
        Where to start, > 0.
    target
        > 0.
    """
    low, high = -math.inf, math.inf  # log α with too large a KL, and with an allowed one
    log_alpha, previous_kl = math.log(alpha), math.nan
    for _ in range(MAX_TRIALS):
        divergence = kl(math.exp(log_alpha))
        if math.isfinite(divergence) and divergence <= target:
            if divergence >= (1.0 - KL_TOLERANCE) * target:
                return math.exp(log_alpha)
            if log_alpha < high and divergence <= previous_kl * 1.01 and low == -math.inf:
                return math.exp(high)
            high, previous_kl = log_alpha, divergence
        else:
            low = log_alpha
        if math.isinf(low) or math.isinf(high):
            log_alpha = max(LOG_MIN_ALPHA, log_alpha + _extrapolate(divergence, target))
        else:
            log_alpha = 0.5 * (low + high)
        if high - low < 1e-6:
            break
    return math.exp(high) if math.isfinite(high) else math.exp(log_alpha)


def _extrapolate(divergence: float, target: float) -> float:
    """Return the change of log α that brings KL ∝ 1/α to the middle of the tolerance."""
    if not math.isfinite(divergence):
        return math.log(100.0)
    middle = (1.0 - 0.5 * KL_TOLERANCE) * target
    change = math.log(max(divergence, 1e-12 * target) / middle)
    # twice the law's step where it is small, so that a flatter law is bracketed soon
    return math.copysign(max(2.0 * abs(change) if abs(change) < 1.0 else abs(change), 0.1), change)
