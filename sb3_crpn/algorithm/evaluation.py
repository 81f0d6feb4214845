"""Trying a step on the batch that it was computed from."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_crpn.curvature.derivatives import policy_distribution
from sb3_crpn.episodes import EpisodeBatch
from sb3_crpn.parameters import ActorParameters
from sb3_crpn.policy import mean_divergence


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
    """Moves the actor to θ + s and back, one forward pass an evaluation.

    Parameters
    ----------
    policy, actor
        The policy at θ, in evaluation mode, and its actor's parameters.
    batch
        The episodes on which steps are tried.
    max_steps
        Most steps in one forward pass, but at least one episode; ``None``: all.

    Attributes
    ----------
    n_trials
        Steps evaluated so far.
    """

    def __init__(
        self,
        policy: ActorCriticPolicy,
        actor: ActorParameters,
        batch: EpisodeBatch,
        max_steps: int | None = None,
    ) -> None:
        self.batch, self.n_trials = batch, 0
        self._policy, self._actor = policy, actor
        self._sizes = torch.tensor([batch.n_steps, batch.size], dtype=torch.float64)
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
        """Leave the actor at θ + ``step``, [d], the same on every rank, and say what that does."""
        self.n_trials += 1
        if not torch.isfinite(step).all():
            return StepEvaluation(math.inf, math.inf)
        self.move(step)
        sums = torch.tensor(self._sums(), dtype=torch.float64)
        total = self.batch.total(torch.cat([sums, self._sizes]))
        divergence, change, n_steps, size = total.tolist()
        return StepEvaluation(divergence / n_steps, change / size)

    def move(self, step: torch.Tensor) -> None:
        """Move the actor to θ + ``step``, [d]."""
        self._actor.load(self._actor.unflatten(self._vector + step))

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
