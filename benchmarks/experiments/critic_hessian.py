"""H with a critic for its cross-time terms, linear in the features of the policy's own critic.

The λ-return Ĝ_i of :mod:`~benchmarks.experiments.cross_time` with b(s) = Bᵀφ(s), c(s) = Cᵀφ(s),
where φ(s) is what the last, linear layer of the policy's V takes, and 1. Of other episodes, with
X = (x_j), Φ = (φ(s_j)) and Φ' = (φ(s_{j+1})), 0 after the last step, ridge LSTD makes

    B = (Φᵀ(Φ - κΦ') + ρI)⁻¹ ΦᵀX,  C = B - (ΦᵀΦ + ρI)⁻¹ ΦᵀX.

Both are linear in the scores, so that VᵀHV needs B and C in the coordinates of V alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from torch import Tensor

from benchmarks.experiments.cross_time import next_values
from sb3_crpn import CRPN
from sb3_crpn.algorithm.update import UpdateData
from sb3_crpn.arrays import FloatArray, IntArray, Observations
from sb3_crpn.curvature import Causal, CurvatureEstimate, GroupedOperator
from sb3_crpn.curvature.derivatives import EpisodeDerivatives
from sb3_crpn.episodes import EpisodeBatch
from sb3_crpn.episodes.batch import episode_scan
from sb3_crpn.parameters import ActorParameters

RIDGE = 1e-4  # ρ, in means of the diagonal of ΦᵀΦ
TRACE = 0.5  # λ_H


@dataclass(frozen=True, eq=False)
class LinearCritic:
    """B and C in n coordinates, [k, n], of k features."""

    values: FloatArray
    baseline: FloatArray


@dataclass(frozen=True, eq=False)
class ProjectedSteps:
    """Episodes end to end, in the coordinates of a basis V, [d, n].

    Attributes
    ----------
    features
        φ(s_i), [T, k].
    scores, rewards
        Vᵀσ_i and Vᵀx_i, x_i = A_iσ_i, [T, n].
    at_once
        Vᵀ Σ_i A_i (σ_iσ_iᵀ + ∇²log π_i) V, [n, n].
    lengths
        Steps of each episode, [E].
    """

    features: FloatArray
    scores: FloatArray
    rewards: FloatArray
    at_once: FloatArray
    lengths: IntArray

    def form(self, kappa: float, trace: float = 1.0, critic: LinearCritic | None = None) -> Tensor:
        """Return VᵀHV, summed over steps, [n, n]; without a critic that of ``Causal``."""
        errors = self.rewards
        ahead = np.zeros_like(errors)
        if critic is not None:
            values = self.features @ critic.values
            following = kappa * next_values(values, self.lengths)
            errors = errors + following - values
            ahead = following - self.features @ critic.baseline
        later = episode_scan(errors, kappa * trace, self.lengths, reverse=True) - errors
        crossed = self.scores.T @ (later + ahead)
        return torch.from_numpy(self.at_once + crossed + crossed.T)


def fit_critic(parts: Sequence[ProjectedSteps], kappa: float, ridge: float = RIDGE) -> LinearCritic:
    """Return the critic of ridge LSTD on all steps of ``parts``."""
    phi = np.concatenate([part.features for part in parts])
    following = np.concatenate([next_values(part.features, part.lengths) for part in parts])
    rewards = np.concatenate([part.rewards for part in parts])
    squares, totals = phi.T @ phi, phi.T @ rewards
    damping = ridge * np.diag(squares).mean() * np.eye(len(squares))
    values = np.linalg.solve(squares - kappa * phi.T @ following + damping, totals)
    return LinearCritic(values, values - np.linalg.solve(squares + damping, totals))


class ScoredEpisodes:
    """Episodes whose scores can be projected: one graph, as in ``EpisodeDerivatives``."""

    def __init__(
        self, policy: ActorCriticPolicy, actor: ActorParameters, batch: EpisodeBatch
    ) -> None:
        self.batch = batch
        self._seen = _SeenScores()
        self._derivatives = EpisodeDerivatives(policy, actor, batch, self._seen)
        self._features = critic_features(policy, batch.observations)

    def project(self, basis: Tensor) -> ProjectedSteps:
        """Return the steps in the coordinates of ``basis``, [d, n]."""
        at_once = (self._derivatives.quadratic_form(basis) * self.batch.size).numpy()
        scores = self._seen.scores
        return ProjectedSteps(
            self._features,
            scores,
            self.batch.cost_advantages[:, None] * scores,
            0.5 * (at_once + at_once.T),
            self.batch.lengths,
        )


class _SeenScores:
    """The pair weights of κ = 0. Keeps the scores' coordinates that it was last applied to."""

    scores: FloatArray

    def apply(self, cost_advantages: FloatArray, lengths: IntArray, u: FloatArray) -> FloatArray:
        """Return A_i u_i, [T, n]."""
        self.scores = u
        return Causal(0.0).apply(cost_advantages, lengths, u)


def critic_features(policy: ActorCriticPolicy, observations: Observations) -> FloatArray:
    """Return φ(s), [T, k]."""
    with torch.no_grad():
        extracted = BasePolicy.extract_features(policy, observations, policy.vf_features_extractor)
        hidden = policy.mlp_extractor.forward_critic(extracted)
    return np.append(hidden.double().numpy(), np.ones((len(hidden), 1)), axis=1)


def cross_fitted_forms(
    parts: Sequence[ProjectedSteps], kappa: float, trace: float, ridge: float = RIDGE
) -> Tensor:
    """Return each part's VᵀHV with a critic of the other parts, summed over steps, [K, n, n]."""
    forms = []
    for k, part in enumerate(parts):
        others = [*parts[:k], *parts[k + 1 :]]
        forms.append(part.form(kappa, trace, fit_critic(others, kappa, ridge)))
    return torch.stack(forms)


class CriticHessian(CRPN):
    """H with a critic: that of each of two folds has been fitted to the other fold.

    For subspaces, of which VᵀHV is asked. κ is ``hessian_lambda``.

    Attributes
    ----------
    trace, ridge
        λ_H, and ρ in means of the diagonal of ΦᵀΦ.
    """

    trace = TRACE
    ridge = RIDGE

    def _estimate(self, data: UpdateData) -> CurvatureEstimate:
        estimate = super()._estimate(data)
        parts = estimate.gradient_batch.split(2)
        if len(parts) < 2:
            return estimate
        folds = [ScoredEpisodes(self.policy, self.actor, part) for part in parts]
        sizes = torch.tensor([float(part.size) for part in parts], dtype=torch.float64)

        def forms(basis: Tensor) -> Tensor:
            steps = [fold.project(basis) for fold in folds]
            found = cross_fitted_forms(steps, self.hessian_lambda, self.trace, self.ridge)
            return found / sizes[:, None, None]

        d = len(estimate.gradient)
        return replace(estimate, hessian=GroupedOperator(d, _no_product, sizes, forms))


def _no_product(vector: Tensor) -> Tensor:
    raise NotImplementedError("H with a critic is known on subspaces alone: set metric='fisher'")
