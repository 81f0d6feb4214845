"""Replay: earlier rollouts, reweighted to the present policy."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_crpn.arrays import FloatArray
from sb3_crpn.episodes.advantages import cost_advantages, generalized_advantages
from sb3_crpn.episodes.batch import EpisodeBatch
from sb3_crpn.episodes.buffer import CHUNK, bootstrap_values
from sb3_crpn.policy import values_and_log_probs

# ρ̄, where importance ratios are truncated (Ionides, Truncated importance sampling, 2008): bounds
# their variance, and leaves untouched what a few steps of the usual target_kl do to most actions
MAX_RATIO = 2.0


class Replay:
    """The last rollouts, importance-weighted to the present policy π on demand.

    With μ the behaviour policy of a rollout, ρ_i = π(a_i|s_i)/μ(a_i|s_i) and c_i = min(1, ρ_i), a
    step counts with

        A_i = -min(ρ̄, ρ_i) Â_i,    Â_i = Σ_l (γλ)^l c_{i+1}⋯c_{i+l} δ_{i+l},

    where δ takes the present V, also of the state that follows a segment, and the critic's target
    is V(s_i) + c_i Â_i (V-trace; Espeholt et al., IMPALA, ICML 2018, with ρ̄ = c̄ = 1 there). For
    π = μ these are the cost advantages of a fresh rollout. That μ visited the states is not
    corrected, as is usual (Queeney et al., Generalized proximal policy optimization with sample
    reuse, NeurIPS 2021). A rollout is dropped once its effective sample size (Σρ)²/Σρ² falls below
    half of its steps.

    Parameters
    ----------
    size
        Maximum number of rollouts.
    gamma, gae_lambda
        γ and λ.

    Attributes
    ----------
    min_effective_size
        Effective sample size, relative to the rollout's size, below which a rollout is dropped:
        0.5, where sequential Monte Carlo resamples (Liu and Chen, Blind deconvolution via
        sequential imputations, JASA 1995).
    """

    min_effective_size = 0.5

    def __init__(self, size: int, gamma: float, gae_lambda: float) -> None:
        self._batches: deque[EpisodeBatch] = deque(maxlen=size)
        self._gamma = gamma
        self._gae_lambda = gae_lambda

    def append(self, batch: EpisodeBatch) -> None:
        """Add a rollout; beyond ``size`` it replaces the oldest."""
        self._batches.append(batch)

    def clear(self) -> None:
        """Drop all rollouts."""
        self._batches.clear()

    def reweighted(self, policy: ActorCriticPolicy, **weighting: bool) -> list[EpisodeBatch]:
        """Return the rollouts, the oldest first, as the present policy sees them.

        ``weighting`` is that of :meth:`EpisodeRolloutBuffer.episode_batch`; each rollout is
        normalised by itself, as it was when it was fresh.
        """
        seen = [(batch, *_evaluate(policy, batch)) for batch in self._batches]
        usable = [entry for entry in seen if self._is_alike(entry[0], entry[-1])]
        self._batches = deque((entry[0] for entry in usable), self._batches.maxlen)
        return [
            self._reweight(batch, values, terminal_values, ratios, **weighting)
            for batch, values, terminal_values, ratios in usable
        ]

    def _is_alike(self, batch: EpisodeBatch, ratios: FloatArray) -> bool:
        """Return whether the effective sample size, over all ranks, is large enough."""
        with np.errstate(over="ignore"):
            sums = [len(ratios), ratios.sum(), (ratios**2).sum()]
        size, total, squares = batch.total(torch.tensor(sums, dtype=torch.float64)).tolist()
        least = self.min_effective_size * size
        return bool(total**2 > least * squares)  # false where a sum is infinite

    def _reweight(
        self,
        batch: EpisodeBatch,
        values: FloatArray,
        terminal_values: FloatArray,
        ratios: FloatArray,
        *,
        baseline: bool,
        **weighting: bool,
    ) -> EpisodeBatch:
        clipped_ratios = np.minimum(ratios, 1.0)
        advantages = generalized_advantages(
            batch.rewards,
            values,
            terminal_values,
            batch.lengths,
            self._gamma,
            self._gae_lambda,
            clipped_ratios,
        )
        costs = cost_advantages(
            advantages if baseline else advantages + values,
            batch.lengths,
            batch.times,
            gamma=self._gamma,
            **weighting,
        )
        return replace(
            batch,
            cost_advantages=np.minimum(ratios, MAX_RATIO) * costs,
            values=values,
            returns=values + clipped_ratios * advantages,
        )


def _evaluate(
    policy: ActorCriticPolicy, batch: EpisodeBatch
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the present policy's V(s_i), [T], V of the states after segments, [E], and ρ_i, [T].

    V is 0 after segments that are not bootstrapped.
    """
    values, log_probs = [np.zeros(0)], [np.zeros(0)]
    for piece in batch.chunks(CHUNK):
        value, log_prob = values_and_log_probs(policy, piece.observations, piece.actions)
        values.append(value.cpu().double().numpy())
        log_probs.append(log_prob.cpu().double().numpy())
    with np.errstate(over="ignore"):  # an infinite ratio ends the rollout's use
        ratios: FloatArray = np.exp(np.concatenate(log_probs) - batch.log_probs)
    terminal_values = bootstrap_values(policy, batch.next_observations, batch.bootstrapped)
    return np.concatenate(values), terminal_values, ratios
