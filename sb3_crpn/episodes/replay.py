"""Earlier rollouts, from which later updates learn again."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_crpn.arrays import FloatArray
from sb3_crpn.distributed import all_sum
from sb3_crpn.episodes.advantages import cost_advantages, generalized_advantages
from sb3_crpn.episodes.batch import EpisodeBatch
from sb3_crpn.episodes.buffer import CHUNK

# ρ̄, where importance ratios are truncated (Ionides, Truncated importance sampling, 2008): bounds
# their variance, and leaves untouched what a few steps of the usual target_kl do to most actions
MAX_RATIO = 2.0
# Effective sample size, relative to the rollout's size, below which a rollout is forgotten: where
# sequential Monte Carlo resamples (Liu and Chen, Blind deconvolution via sequential imputations,
# JASA 1995)
MIN_EFFECTIVE_SIZE = 0.5


class Replay:
    """The last rollouts, reweighted to the present policy on demand.

    With ρ_i = π(a_i|s_i)/π_then(a_i|s_i) and c_i = min(1, ρ_i), a step counts with

        A_i = -min(ρ̄, ρ_i) Â_i,    Â_i = Σ_l (γλ)^l c_{i+1}⋯c_{i+l} δ_{i+l},

    where δ takes the present V, and the critic's target is V(s_i) + c_i Â_i (V-trace; Espeholt et
    al., IMPALA, ICML 2018, with ρ̄ = c̄ = 1 there). For π = π_then these are the weights of a
    fresh rollout. That the states were visited by π_then is not corrected, as is usual (Queeney et
    al., Generalized proximal policy optimization with sample reuse, NeurIPS 2021). A rollout is
    forgotten once its effective sample size (Σρ)²/Σρ² is less than half of its steps: with many
    action components the policy soon leaves what it has seen.

    Parameters
    ----------
    size
        Most rollouts that are kept.
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
        seen = [(batch, *_evaluate(policy, batch)) for batch in self._batches]
        usable = [(batch, values, ratios) for batch, values, ratios in seen if _is_alike(ratios)]
        self._batches = deque((batch for batch, _, _ in usable), self._batches.maxlen)
        return [
            self._reweight(batch, values, ratios, **weighting) for batch, values, ratios in usable
        ]

    def _reweight(
        self,
        batch: EpisodeBatch,
        values: FloatArray,
        ratios: FloatArray,
        *,
        baseline: bool,
        normalize_advantage: bool,
        discount_visitation: bool,
    ) -> EpisodeBatch:
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
        weights = cost_advantages(
            advantages if baseline else advantages + values,
            batch.lengths,
            gamma=self._gamma,
            normalize_advantage=normalize_advantage,
            discount_visitation=discount_visitation,
        )
        return replace(
            batch,
            cost_advantages=np.minimum(ratios, MAX_RATIO) * weights,
            values=values,
            returns=values + traces * advantages,
        )


def _evaluate(policy: ActorCriticPolicy, batch: EpisodeBatch) -> tuple[FloatArray, FloatArray]:
    """Return V(s_i) and ρ_i of the present policy, [T] each."""
    values, log_probs = [np.zeros(0)], [np.zeros(0)]
    for piece in batch.chunks(CHUNK):
        with torch.no_grad():
            value, log_prob, _ = policy.evaluate_actions(piece.observations, piece.actions)
        values.append(value.flatten().cpu().double().numpy())
        log_probs.append(log_prob.cpu().double().numpy())
    with np.errstate(over="ignore"):  # an infinite ratio ends the rollout's use
        return np.concatenate(values), np.exp(np.concatenate(log_probs) - batch.log_probs)


def _is_alike(ratios: FloatArray) -> bool:
    """Tell whether the rollout, over all ranks, still stands for enough of the present policy's."""
    with np.errstate(over="ignore"):
        sums = [len(ratios), ratios.sum(), (ratios**2).sum()]
    size, total, squares = all_sum(torch.tensor(sums, dtype=torch.float64)).tolist()
    return bool(total**2 > MIN_EFFECTIVE_SIZE * size * squares)  # false where a sum is infinite
