"""Earlier rollouts, from which later updates learn again."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_crpn.episodes.advantages import cost_weights, generalized_advantages
from sb3_crpn.episodes.batch import EpisodeBatch, FloatArray
from sb3_crpn.episodes.buffer import CHUNK

# ρ̄, where importance ratios are truncated (Ionides, Truncated importance sampling, 2008): bounds
# their variance, and leaves untouched what a few steps of the usual target_kl do to most actions
MAX_RATIO = 2.0


class EarlierRollouts:
    """The last rollouts, reweighted to the present policy on demand.

    With ρ_i = π(a_i|s_i)/π_then(a_i|s_i) and c_i = min(1, ρ_i), a step counts with

        A_i = -min(ρ̄, ρ_i) Â_i,    Â_i = Σ_l (γλ)^l c_{i+1}⋯c_{i+l} δ_{i+l},

    where δ takes the present V, and the critic's target is V(s_i) + c_i Â_i (V-trace; Espeholt et
    al., IMPALA, ICML 2018, with ρ̄ = c̄ = 1 there). For π = π_then these are the weights of a
    fresh rollout. That the states were visited by π_then is not corrected, as is usual (Queeney et
    al., Generalized proximal policy optimization with sample reuse, NeurIPS 2021).

    Parameters
    ----------
    size
        How many rollouts are kept.
    gamma, gae_lambda
        γ and λ.
    """

    def __init__(self, size: int, gamma: float, gae_lambda: float) -> None:
        self._batches: deque[EpisodeBatch] = deque(maxlen=size)
        self._gamma = gamma
        self._gae_lambda = gae_lambda

    def append(self, batch: EpisodeBatch) -> None:
        """Keep a rollout in place of the oldest."""
        self._batches.append(batch)

    def clear(self) -> None:
        """Forget all."""
        self._batches.clear()

    def reweighted(self, policy: ActorCriticPolicy, **weighting: bool) -> list[EpisodeBatch]:
        """Return the rollouts, the oldest first, as the present policy sees them.

        ``weighting`` is that of :meth:`EpisodeRolloutBuffer.episode_batch`; each rollout is
        normalised by itself, as it was when it was fresh.
        """
        return [self._reweight(policy, batch, **weighting) for batch in self._batches]

    def _reweight(
        self,
        policy: ActorCriticPolicy,
        batch: EpisodeBatch,
        *,
        baseline: bool,
        normalize_advantage: bool,
        discount_visitation: bool,
    ) -> EpisodeBatch:
        values, log_probs = _evaluate(policy, batch)
        ratios = np.exp(log_probs - batch.log_probs)
        traces = np.minimum(ratios, 1.0)
        advantages = generalized_advantages(
            batch.rewards,
            values,
            batch.terminal_values,
            batch.lengths,
            self._gamma,
            self._gae_lambda,
            traces,
        )
        weights = cost_weights(
            advantages if baseline else advantages + values,
            batch.lengths,
            gamma=self._gamma,
            normalize_advantage=normalize_advantage,
            discount_visitation=discount_visitation,
        )
        return replace(
            batch,
            weights=np.minimum(ratios, MAX_RATIO) * weights,
            values=values,
            returns=values + traces * advantages,
        )


def _evaluate(policy: ActorCriticPolicy, batch: EpisodeBatch) -> tuple[FloatArray, FloatArray]:
    """Return V(s_i) and log π(a_i|s_i) of the present policy, [T] each."""
    values, log_probs = [np.zeros(0)], [np.zeros(0)]
    for piece in batch.pieces(CHUNK):
        with torch.no_grad():
            value, log_prob, _ = policy.evaluate_actions(piece.observations, piece.actions)
        values.append(value.flatten().cpu().double().numpy())
        log_probs.append(log_prob.cpu().double().numpy())
    return np.concatenate(values), np.concatenate(log_probs)
