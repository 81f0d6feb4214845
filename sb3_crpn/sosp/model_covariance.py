"""Model-based (Rao-Blackwell) covariance of gradient estimates, and the episodes' Fisher matrix."""

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

# Expected number of rare actions in all episodes together. A Poisson variable of mean 5 is zero
# with probability 0.7 %
MAX_RARE_COUNT = 5.0


def model_covariance(
    policy: ActorCriticPolicy,
    actor: ActorParameters,
    batch: EpisodeBatch,
    n_blocks: int,
    gamma: float,
) -> Operator:
    r"""Return v ↦ Bv, the model-based (Rao-Blackwell) covariance of a block's mean of Σ_i A_i σ_i.

    .. math:: B = \frac{K}{E^2} \sum_i \Big[ A_i^2 F(s_i)
              + \sum_{a\ \text{rare}} \pi_{ia} C_i^2\, \sigma_{ia} \sigma_{ia}^T \Big],
              \qquad F(s) = E_{a\sim\pi(\cdot|s)}[\sigma\sigma^T],

    E episodes in K blocks. The scores' second moments are expectations under π(·|s_i) in place of
    the sampled actions. A_i² is taken to be independent of the action.

    The rare actions of a discrete policy are the least probable ones, with an expected number of at
    most :data:`MAX_RARE_COUNT` in all episodes together. The sampled A_i carry no information on
    them. Their cost-to-go is supposed to lie in [-|Ψ_i|, |Ψ_i|], whence C_i = |Ψ_i| + γ^i|V(s_i)|.

    B is computed as the Hessian at θ of a scalar function of the policy. Its first term is a
    weighted KL divergence, its second a weighted square of log π.

    Parameters
    ----------
    policy, actor
        The policy and its parameters, of length d.
    batch
        E whole episodes with Ψ_i and A_i.
    n_blocks
        K.
    gamma
        γ.

    Returns
    -------
    Operator
        v ↦ Bv, float64 [d] to [d].
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
    product = _hessian_product(potential, actor)
    return lambda vector: product(vector) * n_blocks / batch.n_episodes**2


def episode_fisher(
    policy: ActorCriticPolicy, actor: ActorParameters, batch: EpisodeBatch
) -> Operator:
    """Return v ↦ Fv, the Fisher matrix of the distribution p of episodes, F = (1/E) Σ_i F(s_i).

    KL(p_θ ‖ p_θ+v) = ½ vᵀFv + O(‖v‖³).
    """
    with torch.no_grad():
        reference = policy_distribution(policy, batch)
    divergence = kl_divergence(reference, policy_distribution(policy, batch))
    product = _hessian_product(divergence.sum(), actor)
    return lambda vector: product(vector) / batch.n_episodes


def _hessian_product(potential: Tensor, actor: ActorParameters) -> Operator:
    """Return v ↦ ∇²(potential) v, one backward pass a product."""
    gradient = torch.autograd.grad(
        potential, actor.tensors, create_graph=True, materialize_grads=True
    )

    def hessian_product(vector: Tensor) -> Tensor:
        along = [(a * b).sum() for a, b in zip(gradient, actor.unflatten(vector), strict=True)]
        product = torch.autograd.grad(
            torch.stack(along).sum(), actor.tensors, retain_graph=True, materialize_grads=True
        )
        return actor.flatten(product)

    return hessian_product


def _log_probabilities(distribution: Distribution) -> Tensor | None:
    """Return log π of all values of discrete action components, [T, M]; None for others."""
    inner: Any = distribution.distribution
    if isinstance(inner, Bernoulli):
        return logsigmoid(torch.cat([inner.logits, -inner.logits], dim=1))
    components = inner if isinstance(inner, list) else [inner]
    if not all(isinstance(component, Categorical) for component in components):
        return None
    return torch.cat([component.logits for component in components], dim=1)


def _rare_probabilities(log_probs: Tensor) -> Tensor:
    """Return the smallest probabilities, of sum ≤ ``MAX_RARE_COUNT``, and 0 elsewhere, [T, M]."""
    probabilities = log_probs.exp().flatten().double()
    ascending, order = probabilities.sort()
    rare = torch.zeros_like(probabilities)
    chosen = order[ascending.cumsum(0) <= MAX_RARE_COUNT]
    rare[chosen] = probabilities[chosen]
    return rare.to(log_probs.dtype).reshape(log_probs.shape)
