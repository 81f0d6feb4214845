"""Trying a step on the batch that it was computed from, and fitting its length to a KL target."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_crpn.curvature.scores import mean_divergence, policy_distribution
from sb3_crpn.episodes import EpisodeBatch
from sb3_crpn.parameters import ActorParameters

# target_kl counts as met within 10 per cent (DESIGN section 5)
KL_TOLERANCE = 0.1
# Bisection on log α: 40 trials narrow 30 decades to the tolerance
MAX_TRIALS = 40


@dataclass(frozen=True)
class Trial:
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


class StepTester:
    """Moves the actor to θ + s and back, one forward pass a trial.

    Parameters
    ----------
    policy, actor
        The policy at θ, in evaluation mode, and its actor's parameters.
    batch
        The episodes on which steps are tried.
    """

    def __init__(
        self, policy: ActorCriticPolicy, actor: ActorParameters, batch: EpisodeBatch
    ) -> None:
        self._policy, self._actor, self._batch = policy, actor, batch
        self._origin = actor.snapshot()
        self._vector = actor.vector
        with torch.no_grad():
            self._reference = policy_distribution(policy, batch)
            self._log_prob = self._reference.log_prob(batch.actions)
        self._weights = self._log_prob.new_tensor(batch.weights)

    def try_step(self, step: torch.Tensor) -> Trial:
        """Leave the actor at θ + ``step``, [d], and say what that does."""
        if not torch.isfinite(step).all():
            return Trial(math.inf, math.inf)
        self._actor.restore(self._actor.unflatten(self._vector + step))
        try:
            with torch.no_grad():
                distribution = policy_distribution(self._policy, self._batch)
                log_ratio = distribution.log_prob(self._batch.actions) - self._log_prob
                divergence = mean_divergence(self._reference, distribution)
        except ValueError:  # torch's distributions refuse parameters that are not finite
            return Trial(math.inf, math.inf)
        change = (self._weights * torch.expm1(log_ratio)).double().sum() / self._batch.n_episodes
        return Trial(divergence.item(), change.item())

    def restore(self) -> None:
        """Put the actor back to θ, bit for bit."""
        self._actor.restore(self._origin)


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
            log_alpha += _extrapolate(divergence, target)
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
