"""The noise of gradient estimates that the policy's own probabilities imply."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from stable_baselines3.common.distributions import Distribution, kl_divergence
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import Tensor
from torch.distributions import Bernoulli, Categorical
from torch.nn.functional import logsigmoid

from sb3_crpn.arrays import Operator
from sb3_crpn.curvature.derivatives import policy_distribution
from sb3_crpn.episodes.batch import EpisodeBatch, discount_factors
from sb3_crpn.parameters import ActorParameters

# Actions expected so many times in all the episodes, and no more, may be missing from them: a
# Poisson variable of mean 5 is zero with probability 0.7 %
RARE = 5.0


def model_covariance(
    policy: ActorCriticPolicy,
    actor: ActorParameters,
    batch: EpisodeBatch,
    n_blocks: int,
    gamma: float,
) -> Operator:
    r"""Return v ↦ Bv, the covariance of a block's mean of Σ_i A_i σ_i without the luck of actions.

    .. math:: B = \frac{K}{E^2} \sum_i \Big[ A_i^2 F(s_i)
              + \sum_{a\ \text{rare}} \pi_{ia} C_i^2\, \sigma_{ia} \sigma_{ia}^T \Big],
              \qquad F(s) = E_{a\sim\pi(\cdot|s)}[\sigma\sigma^T],

    E episodes in K blocks. The actions are averaged at the probabilities that the policy gives
    them, A_i² taken not to depend on them. Of the least probable actions of discrete policies,
    expected :data:`RARE` times together, the weights of those taken tell nothing; they are supposed
    to turn the cost-to-go to its opposite at most, C_i = |Ψ_i| + γ^i|V(s_i)|.

    Both terms are the Hessian at θ of one function of the policy, a KL divergence and a square.
    """
    with torch.no_grad():
        reference = policy_distribution(policy, batch)
    current = policy_distribution(policy, batch)
    divergence = kl_divergence(reference, current).reshape(batch.n_steps, -1).sum(1)
    potential = (divergence.new_tensor(batch.cost_advantages**2) * divergence).sum()
    log_probs = _log_probabilities(current)
    if log_probs is not None:
        costs = discount_factors(gamma, batch.lengths) * batch.returns
        scale = log_probs.new_tensor(np.abs(costs) + np.abs(batch.cost_advantages + costs))
        weights = _rare_probabilities(log_probs.detach()) * scale[:, None] ** 2
        potential = potential + 0.5 * (weights * (log_probs - log_probs.detach()) ** 2).sum()
    product = _hessian(potential, actor)
    return lambda vector: product(vector) * n_blocks / batch.n_episodes**2


def episode_fisher(
    policy: ActorCriticPolicy, actor: ActorParameters, batch: EpisodeBatch
) -> Operator:
    """Return v ↦ Fv, the Fisher matrix of an episode's distribution, F = (1/E) Σ_i F(s_i).

    KL(p_θ ‖ p_θ+v) = ½ vᵀFv + O(‖v‖³) for the distribution p of whole episodes.
    """
    with torch.no_grad():
        reference = policy_distribution(policy, batch)
    divergence = kl_divergence(reference, policy_distribution(policy, batch))
    product = _hessian(divergence.sum(), actor)
    return lambda vector: product(vector) / batch.n_episodes


def _hessian(potential: Tensor, actor: ActorParameters) -> Operator:
    """Return v ↦ ∇²(potential) v, one backward pass a product."""
    slope = torch.autograd.grad(potential, actor.tensors, create_graph=True, materialize_grads=True)

    def product(vector: Tensor) -> Tensor:
        along = [(a * b).sum() for a, b in zip(slope, actor.unflatten(vector), strict=True)]
        curvature = torch.autograd.grad(
            torch.stack(along).sum(), actor.tensors, retain_graph=True, materialize_grads=True
        )
        return actor.flatten(curvature)

    return product


def _log_probabilities(distribution: Distribution) -> Tensor | None:
    """Return log π of every value of every discrete action component, [T, M]; or ``None``."""
    inner: Any = distribution.distribution
    if isinstance(inner, Bernoulli):
        return logsigmoid(torch.cat([inner.logits, -inner.logits], dim=1))
    components = inner if isinstance(inner, list) else [inner]
    if not all(isinstance(component, Categorical) for component in components):
        return None
    return torch.cat([component.logits for component in components], dim=1)


def _rare_probabilities(log_probs: Tensor) -> Tensor:
    """Return the least probabilities, up to a sum of ``RARE``, zero elsewhere, [T, M]."""
    probabilities = log_probs.exp().flatten().double()
    ascending, order = probabilities.sort()
    rare = torch.zeros_like(probabilities)
    chosen = order[ascending.cumsum(0) <= RARE]
    rare[chosen] = probabilities[chosen]
    return rare.to(log_probs.dtype).reshape(log_probs.shape)
