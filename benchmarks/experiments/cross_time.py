"""H with a critic for its cross-time terms: on episodes, and in expectation.

With x_j = A_j σ_j the cross-time part of H is E Σ_i (σ_i G_iᵀ + G_i σ_iᵀ), where
G_i = Σ_{j>i} κ^{j-i} x_j is a return with the reward x_j, a vector. Its critic b(s) estimates
E[Σ_{k≥j} κ^{k-j} x_k | s_j = s], and is 0 after the last step; for κ = 1 this is -∇V(s). In place
of G_i stands the λ-return

    Ĝ_i = κ b(s_{i+1}) - c(s_i) + Σ_{l≥1} (κ λ_H)^l δ_{i+l},  δ_j = x_j + κ b(s_{j+1}) - b(s_j).

For λ_H = 1 the sum telescopes, so that Ĝ_i = G_i - c(s_i). c is a baseline: H keeps its expectation
for any b and c of other episodes. For λ_H < 1 errors of b are a bias. c(s) = b(s) - E[x|s], the
mean of κ b(s_{i+1}). Without a critic, b = c = 0, Ĝ_i is G_i with κ λ_H in place of κ.
Σ_{l≥0} (κ λ_H)^l δ_{i+1+l} would not do: it subtracts b(s_{i+1}), which depends on a_i.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor
from torch.autograd.functional import jacobian

from benchmarks.exact import TabularMDP
from benchmarks.experiments.reuse import visitation
from sb3_crpn.arrays import FloatArray, IntArray
from sb3_crpn.episodes import EpisodeBatch
from sb3_crpn.episodes.batch import episode_scan, episode_starts


@dataclass(frozen=True, eq=False)
class Critic:
    """b(s) and c(s), [S, d]."""

    values: FloatArray
    baseline: FloatArray

    @property
    def coefficients(self) -> FloatArray:
        """(I, b, -c), [d + 2S, d]."""
        identity = np.eye(self.values.shape[1])
        return np.concatenate([identity, self.values, -self.baseline])


class Chain:
    """The states under a policy: exact expectations. Episodes end before the horizon.

    Attributes
    ----------
    theta
        The policy's parameters.
    scores, curvature
        ∇log π(a|s), [S, A, d], and σσᵀ + ∇²log π, [S, A, d, d].
    """

    def __init__(self, mdp: TabularMDP, theta: Tensor) -> None:
        policy = mdp.probabilities(theta)
        self.theta, self._flow = theta, mdp.flow.numpy()
        self.scores: FloatArray = jacobian(lambda at: mdp.probabilities(at).log(), theta).numpy()
        self._policy = policy.numpy()
        self._kernel = np.einsum("sa,sat->st", self._policy, self._flow)
        squares = np.einsum("sai,saj->saij", self.scores, self.scores)
        # ∇²log π of a softmax of logits linear in θ is the same for all actions
        mean = np.einsum("sa,saij->sij", self._policy, squares)
        self.curvature: FloatArray = squares - mean[:, None]
        values = mdp.values(theta)[0]
        A = self._policy * (values[:, None] - mdp.action_values(values)).numpy()
        self._rewards = np.einsum("sa,sai->si", A, self.scores)  # E[x|s]
        self._visits = visitation(mdp, theta).numpy() * mdp.mean_length(theta)
        self._at_once = np.einsum("s,sa,saij->ij", self._visits, A, self.curvature)

    def critic(self, kappa: float) -> Critic:
        """Return the exact critic."""
        values = np.linalg.solve(np.eye(len(self._kernel)) - kappa * self._kernel, self._rewards)
        return Critic(values, values - self._rewards)

    def expected(self, critic: Critic, kappa: float, trace: float) -> FloatArray:
        """Return the expectation of H, [d, d], with a critic that is independent of its episodes.

        c contributes nothing to it.
        """
        b = critic.values
        errors = self._rewards + kappa * self._kernel @ b - b
        decayed = np.eye(len(b)) - kappa * trace * self._kernel
        ahead = kappa * (b + trace * np.linalg.solve(decayed, errors))
        returns = np.einsum("sat,tj->saj", self._flow, ahead)
        crossed = np.einsum("s,sa,sai,saj->ij", self._visits, self._policy, self.scores, returns)
        expected: FloatArray = self._at_once + crossed + crossed.T
        return expected


@dataclass(frozen=True, eq=False)
class Steps:
    """Episodes end to end: states [T], scores σ_i [T, d], x_i [T, d], and lengths [E].

    ``at_once`` is Σ_i A_i (σ_iσ_iᵀ + ∇²log π_i) of each episode, [E, d, d].
    """

    states: IntArray
    scores: FloatArray
    rewards: FloatArray
    at_once: FloatArray
    lengths: IntArray

    @classmethod
    def of(cls, chain: Chain, batch: EpisodeBatch) -> Steps:
        """Return the steps of a batch."""
        assert isinstance(batch.observations, Tensor)
        states = batch.observations.argmax(1).numpy()  # state = observation
        chosen = states, batch.actions.long().flatten().numpy()
        A, scores = batch.cost_advantages, chain.scores[chosen]
        curvature = A[:, None, None] * chain.curvature[chosen]
        at_once = np.add.reduceat(curvature, episode_starts(batch.lengths))
        return cls(states, scores, A[:, None] * scores, at_once, batch.lengths)

    def fit(self, kappa: float, n_states: int) -> Critic:
        """Return the critic of LSTD, 0 for states that were not visited."""
        features = np.eye(n_states)[self.states]
        totals = features.T @ self.rewards
        differences = features - kappa * next_values(features, self.lengths)
        values = np.linalg.pinv(features.T @ differences) @ totals
        visits = np.maximum(features.sum(0), 1.0)[:, None]
        return Critic(values, values - totals / visits)

    def returns(self, kappa: float, trace: float, n_states: int) -> FloatArray:
        """Return Ĝ_i as multiples of a critic's (I, b, -c), [T, d + 2S]."""
        present = np.eye(n_states)[self.states]
        following = kappa * next_values(present, self.lengths)
        errors = np.append(self.rewards, following - present, axis=1)
        later = episode_scan(errors, kappa * trace, self.lengths, reverse=True) - errors
        later[:, -n_states:] += following
        return np.append(later, present, axis=1)

    def crossed(self, kappa: float, trace: float, n_states: int) -> FloatArray:
        """Return each episode's Σ_i σ_i Ĝ_iᵀ as multiples of the same, [E, d, d + 2S]."""
        pairs = self.scores[:, :, None] * self.returns(kappa, trace, n_states)[:, None]
        crossed: FloatArray = np.add.reduceat(pairs, episode_starts(self.lengths))
        return crossed


def next_values(values: FloatArray, lengths: IntArray) -> FloatArray:
    """Return the value of the next step, 0 after the last step of an episode, [T, k]."""
    following = np.roll(values, -1, axis=0)
    following[np.cumsum(lengths) - 1] = 0.0
    return following


def hessians(steps: Steps, crossed: FloatArray, critic: Critic) -> FloatArray:
    """Return each episode's H with a critic, [E, d, d]."""
    pairs = crossed @ critic.coefficients
    found: FloatArray = steps.at_once + pairs + pairs.transpose(0, 2, 1)
    return found
