"""Products with the scores σ_i = ∇log π(a_i|s_i;θ) of one group of episodes."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from stable_baselines3.common.distributions import (
    Distribution,
    MultiCategoricalDistribution,
    kl_divergence,
)
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_crpn.arrays import FloatArray, IntArray
from sb3_crpn.episodes.batch import EpisodeBatch, episode_scan, episode_starts
from sb3_crpn.parameters import ActorParameters

HessianEstimator = Literal["causal", "trajectory"]


def policy_distribution(policy: ActorCriticPolicy, batch: EpisodeBatch) -> Distribution:
    """Return π(·|s_i;θ) over the batch; a copy, because SB3's policies reuse one object."""
    return copy.copy(policy.get_distribution(batch.observations))


def mean_divergence(old: Distribution, new: Distribution) -> torch.Tensor:
    """Return the mean of KL(old ‖ new) over the states and the action's k components, a scalar.

    The mean, not the sum, over components is what sb3-contrib's TRPO bounds: a step of one and
    the same divergence changes each component as much whether there are one or twenty.
    """
    divergence = kl_divergence(old, new)  # [T], or [T, k] where SB3 keeps the components apart
    if isinstance(old, MultiCategoricalDistribution):  # which SB3 sums
        divergence = divergence / len(old.action_dims)
    return divergence.mean()


@dataclass(frozen=True)
class PairWeights:
    """The symmetric pair weights W of a Hessian estimator, applied in O(T).

    - ``"trajectory"``: W_ij = ½(A_i + A_j), the symmetric part of the paper's estimator
      (Maniyar et al., Theorem 1).
    - ``"causal"``: W_ij = κ^|i-j| A_max(i,j). κ = 1 is the Hessian of the DiCE objective (Foerster
      et al., ICML 2018) and of Furmston et al., JMLR 2016; κ = 0 keeps the curvature of the
      per-step surrogate alone.
    """

    estimator: HessianEstimator
    decay: float = 1.0

    def apply(self, weights: FloatArray, lengths: IntArray, u: FloatArray) -> FloatArray:
        """Return w_i = Σ_j W_ij u_j, the sum over j within the episode of i, [T] or [T, k].

        Parameters
        ----------
        weights
            A_i, [T], episodes end to end.
        lengths
            Steps of each episode, [E].
        u
            u_j, [T], or k such vectors, [T, k].
        """
        weights = weights.reshape(-1, *[1] * (u.ndim - 1))
        if self.estimator == "trajectory":
            return 0.5 * (
                weights * _episode_totals(u, lengths) + _episode_totals(weights * u, lengths)
            )
        # j ≤ i: A_i Σ κ^(i-j) u_j;  j > i: Σ κ^(j-i) A_j u_j
        past = episode_scan(u, self.decay, lengths)
        weighted = weights * u
        future = episode_scan(weighted, self.decay, lengths, reverse=True) - weighted
        return weights * past + future


def _episode_totals(values: FloatArray, lengths: IntArray) -> FloatArray:
    """Return for each step the sum of ``values`` over its episode, [T] or [T, k]."""
    totals: FloatArray = np.add.reduceat(values, episode_starts(lengths), axis=0)
    return totals.repeat(lengths, axis=0)


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
    pair_weights
        W of the Hessian estimator.
    """

    def __init__(
        self,
        policy: ActorCriticPolicy,
        actor: ActorParameters,
        batch: EpisodeBatch,
        pair_weights: PairWeights,
    ) -> None:
        self.batch = batch
        self._policy = policy
        self._actor = actor
        self._pair_weights = pair_weights

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
        return self._actor.flatten(s.detach() for s in score) / self.batch.n_episodes

    def hessian_product(self, vector: torch.Tensor) -> torch.Tensor:
        """Return (1/n) Σ_episodes [Σ_ij W_ij σ_i σ_jᵀ + Σ_i A_i ∇²log π_i] v, [d].

        With u = Jv and w = Wu, J = ∂log π/∂θ, this is (1/n)[Jᵀw + ∇(Σ_i A_i σ_i·v)]. Because
        Σ A_i σ_i·v is linear in A, one backward pass gives both u and the second term.
        """
        u, curvature = self._along(vector)
        w = self._pair_weights.apply(
            self.batch.cost_advantages, self.batch.lengths, u.to("cpu", torch.float64).numpy()
        )
        outer = torch.autograd.grad(
            self._log_prob,
            self._actor.tensors,
            self._log_prob.new_tensor(w),
            retain_graph=True,
            materialize_grads=True,
        )
        return (self._actor.flatten(outer) + curvature) / self.batch.n_episodes

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
        outer = U.T @ self._pair_weights.apply(self.batch.cost_advantages, self.batch.lengths, U)
        return (torch.from_numpy(outer).to(basis) + basis.T @ curvature) / self.batch.n_episodes

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
