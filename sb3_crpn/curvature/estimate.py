"""Estimates of ∇J, ∇²J and the Fisher matrix from whole episodes, as linear operators."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_crpn.curvature.scores import EpisodeGroup, PairWeights
from sb3_crpn.distributed import all_sum
from sb3_crpn.episodes.batch import EpisodeBatch
from sb3_crpn.parameters import ActorParameters

# Groups whose disagreement measures the noise: two give an unbiased estimate of it, and more of
# them would run smaller, less efficient products.
N_GROUPS = 2


class EpisodeOperator:
    """A symmetric d × d matrix B = Σ_k w_k B_k, known through its products B_k v.

    k runs over groups of whole episodes; Σ w_k = 1. ``operator @ v`` costs one product with each
    group.

    Parameters
    ----------
    size
        d.
    products
        v ↦ B_k v for each group, float64 [d] to [d].
    sizes
        What w_k is proportional to: the group's episodes, or its steps.
    """

    def __init__(
        self,
        size: int,
        products: Sequence[Callable[[torch.Tensor], torch.Tensor]],
        sizes: Sequence[int],
    ) -> None:
        self.shape = (size, size)
        self._products = products
        own = torch.tensor(sizes, dtype=torch.float64)
        self.weights = own / all_sum(own.sum())

    def group_products(self, vector: torch.Tensor) -> torch.Tensor:
        """Return B_k v for each group, [K, d]."""
        return torch.stack([product(vector) for product in self._products])

    def __matmul__(self, other: torch.Tensor) -> torch.Tensor:
        """Return B v for v of shape [d], or B V for V of shape [d, n]; float64."""
        other = torch.as_tensor(other, dtype=torch.float64)
        if other.shape[:1] != self.shape[:1] or other.ndim > 2:
            raise ValueError(
                f"operand has shape {tuple(other.shape)}, must be ({self.shape[1]},) "
                f"or ({self.shape[1]}, n)"
            )
        if other.ndim == 2:
            return torch.stack([self @ column for column in other.T], dim=1)
        return self.mean(self.group_products(other))

    def mean(self, groups: torch.Tensor) -> torch.Tensor:
        """Return Σ_k w_k x_k for x_k of any shape, [K, …] to […]."""
        return all_sum(torch.tensordot(self.weights.to(groups.device), groups, dims=1))

    def to_dense(self) -> torch.Tensor:
        """Return B, exactly symmetric, [d, d]: d products, for small d and for tests."""
        matrix = self @ torch.eye(self.shape[0], dtype=torch.float64)
        return 0.5 * (matrix + matrix.T)


@dataclass(frozen=True)
class CurvatureEstimate:
    """The local geometry of J at θ, estimated from episodes.

    Attributes
    ----------
    gradient
        g ≈ ∇J(θ), float64 [d].
    hessian
        H ≈ ∇²J(θ).
    fisher
        F, the policy's Fisher matrix, a mean over the steps of the gradient's episodes and over
        the action's components.
    gradient_noise
        Estimate of E‖g - ∇J‖² / ‖g‖², from the disagreement of groups; nan for one episode.
    gradient_batch
        The episodes of g.
    """

    gradient: torch.Tensor
    hessian: EpisodeOperator
    fisher: EpisodeOperator
    gradient_noise: float
    gradient_batch: EpisodeBatch


def estimate_curvature(
    policy: ActorCriticPolicy,
    actor: ActorParameters,
    gradient_batch: EpisodeBatch,
    hessian_batch: EpisodeBatch,
    pair_weights: PairWeights,
) -> CurvatureEstimate:
    """Estimate g, H and F as in DESIGN section 2.

    Parameters
    ----------
    policy, actor
        The policy at θ, in evaluation mode, and its actor's parameters.
    gradient_batch, hessian_batch
        The m episodes of g and F and the b of H. When they are the same object, the graphs are
        shared.
    pair_weights
        W of the Hessian estimator.
    """

    def group(batch: EpisodeBatch) -> list[EpisodeGroup]:
        return [EpisodeGroup(policy, actor, part, pair_weights) for part in batch.split(N_GROUPS)]

    of_gradient = group(gradient_batch)
    of_hessian = of_gradient if hessian_batch is gradient_batch else group(hessian_batch)
    gradients = torch.stack([part.gradient() for part in of_gradient])
    shares = torch.tensor([part.batch.n_episodes for part in of_gradient], dtype=torch.float64)
    shares = (shares / all_sum(shares.sum())).to(gradients.device)
    return CurvatureEstimate(
        gradient=all_sum(shares @ gradients),
        hessian=EpisodeOperator(
            len(actor),
            [part.hessian_product for part in of_hessian],
            [part.batch.n_episodes for part in of_hessian],
        ),
        fisher=EpisodeOperator(
            len(actor),
            [part.fisher_product for part in of_gradient],
            [part.batch.n_steps for part in of_gradient],
        ),
        gradient_noise=relative_noise(gradients, shares),
        gradient_batch=gradient_batch,
    )


def relative_noise(groups: torch.Tensor, weights: torch.Tensor) -> float:
    """Return Σ_k w_k ‖x_k - x‖² / ((K - 1) ‖x‖²), x = Σ_k w_k x_k.

    An estimate of E‖x - E x‖² / ‖x‖² from the means x_k [K, …] of K independent groups whose
    sizes are as w_k. For K = 2 the numerator is w_1 w_2 ‖x_1 - x_2‖². nan when K = 1 or x = 0.
    """
    n_groups = all_sum(torch.tensor(len(groups))).item()
    mean = all_sum(torch.tensordot(weights, groups, dims=1))
    size = (mean**2).sum().item()
    if n_groups < 2 or size == 0.0:
        return float("nan")
    spread = all_sum((weights * ((groups - mean) ** 2).flatten(1).sum(1)).sum()).item()
    return spread / (n_groups - 1) / size
