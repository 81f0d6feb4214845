"""Products with the scores σ_i = ∇log π(a_i|s_i;θ) of one group of episodes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import torch
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_crpn.curvature.pair_weights import HessianEstimator
from sb3_crpn.episodes.batch import EpisodeBatch
from sb3_crpn.parameters import ActorParameters
from sb3_crpn.policy import action_distribution, mean_divergence


def policy_distribution(policy: ActorCriticPolicy, batch: EpisodeBatch) -> Distribution:
    """Return π(·|s_i;θ) over the batch."""
    return action_distribution(policy, batch.observations)


class EpisodeDerivatives:
    """The sums of DESIGN section 2 over one group of n episodes, as products with vectors.

    One forward pass is made and its graph kept, so that a product costs about two backward
    passes. Vectors are float64 [d]; the network keeps its own precision.

    Parameters
    ----------
    policy, actor
        The policy at θ and its actor's parameters.
    batch
        The episodes with their weights A_i.
    estimator
        Brings the pair weights W.
    """

    def __init__(
        self,
        policy: ActorCriticPolicy,
        actor: ActorParameters,
        batch: EpisodeBatch,
        estimator: HessianEstimator,
    ) -> None:
        self.batch = batch
        self._policy = policy
        self._actor = actor
        self._estimator = estimator

    @cached_property
    def _distribution(self) -> Distribution:
        return policy_distribution(self._policy, self.batch)

    @cached_property
    def _log_prob(self) -> torch.Tensor:
        return self._distribution.log_prob(self.batch.actions)

    @cached_property
    def _weighted_score(self) -> tuple[torch.Tensor, Sequence[torch.Tensor]]:
        """The weights A as a leaf tensor, and Σ A_i σ_i with its graph: linear in A."""
        weights = self._log_prob.new_tensor(self.batch.cost_advantages).requires_grad_()
        score = torch.autograd.grad(
            self._log_prob,
            self._actor.tensors,
            weights,
            create_graph=True,
            materialize_grads=True,
        )
        return weights, score

    @cached_property
    def _kl_gradient(self) -> Sequence[torch.Tensor]:
        """∇KL(π_θ0 ‖ π_θ) at θ = θ0 with its graph: zero, but its derivative is F."""
        with torch.no_grad():
            reference = policy_distribution(self._policy, self.batch)
        return torch.autograd.grad(
            mean_divergence(reference, self._distribution),
            self._actor.tensors,
            create_graph=True,
            materialize_grads=True,
        )

    def gradient(self) -> torch.Tensor:
        """Return (1/n) Σ_episodes Σ_i A_i σ_i, [d] (Theorem 1)."""
        _, score = self._weighted_score
        return self._actor.flatten(s.detach() for s in score) / self.batch.size

    def hessian_product(self, vector: torch.Tensor) -> torch.Tensor:
        """Return (1/n) Σ_episodes [Σ_ij W_ij σ_i σ_jᵀ + Σ_i A_i ∇²log π_i] v, [d].

        With u = Jv and w = Wu, J = ∂log π/∂θ, this is (1/n)[Jᵀw + ∇(Σ_i A_i σ_i·v)]. Because
        Σ A_i σ_i·v is linear in A, one backward pass gives both u and the second term.
        """
        u, curvature = self._along(vector)
        w = self._estimator.apply(
            self.batch.cost_advantages, self.batch.lengths, u.to("cpu", torch.float64).numpy()
        )
        outer = torch.autograd.grad(
            self._log_prob,
            self._actor.tensors,
            self._log_prob.new_tensor(w),
            retain_graph=True,
            materialize_grads=True,
        )
        return (self._actor.flatten(outer) + curvature) / self.batch.size

    def quadratic_form(self, basis: torch.Tensor) -> torch.Tensor:
        """Return VᵀHV for V = ``basis`` [d, k], H as in :meth:`hessian_product`, [k, k].

        Half the backward passes of k products: with U = JV the first term is UᵀWU, which needs no
        Jᵀ.
        """
        u, curvature = (
            torch.stack(columns, dim=1)
            for columns in zip(*(self._along(vector) for vector in basis.T), strict=True)
        )
        U = u.to("cpu", torch.float64).numpy()
        outer = U.T @ self._estimator.apply(self.batch.cost_advantages, self.batch.lengths, U)
        return (torch.from_numpy(outer).to(basis) + basis.T @ curvature) / self.batch.size

    def _along(self, vector: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return u = Jv, [T], and ∇(Σ_i A_i σ_i·v), [d], by one backward pass."""
        weights, score = self._weighted_score
        u, *curvature = torch.autograd.grad(
            _inner(score, self._actor.unflatten(vector)),
            (weights, *self._actor.tensors),
            retain_graph=True,
            materialize_grads=True,
        )
        return u, self._actor.flatten(curvature)

    def fisher_product(self, vector: torch.Tensor) -> torch.Tensor:
        """Return Fv, F = (1/kT) Σ_i E_{a~π(·|s_i)}[σσᵀ] for actions of k components, [d].

        The expectation over actions is exact: F is the second derivative of `mean_divergence`.
        """
        along = _inner(self._kl_gradient, self._actor.unflatten(vector))
        product = torch.autograd.grad(
            along, self._actor.tensors, retain_graph=True, materialize_grads=True
        )
        return self._actor.flatten(product)


def _inner(left: Sequence[torch.Tensor], right: Sequence[torch.Tensor]) -> torch.Tensor:
    """Return Σ ⟨left, right⟩ over the parameters' tensors."""
    return torch.stack([(a * b).sum() for a, b in zip(left, right, strict=True)]).sum()
