"""Independent estimates of ∇J and ∇²J from blocks of whole episodes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import Tensor

from sb3_crpn.arrays import Operator
from sb3_crpn.curvature import Causal
from sb3_crpn.curvature.derivatives import EpisodeDerivatives
from sb3_crpn.episodes import EpisodeBatch
from sb3_crpn.parameters import ActorParameters
from sb3_crpn.progress import Tick
from sb3_crpn.sosp.model_covariance import model_covariance

# The causal estimator at κ = 1: unbiased (DESIGN section 2)
UNBIASED = Causal(1.0)

# Up to this d every block's Hessian is written out: d products with each, fewer than the directions
# and the limits would otherwise take
DENSE = 16


@dataclass(frozen=True)
class BatchMeans:
    """K independent and identically distributed pairs (g_k, H_k) with means ∇J and ∇²J.

    Block k belongs to half k mod 2; K is even. Ĥ and ĝ are the means over all blocks.

    Attributes
    ----------
    gradients
        g_k, float64 [K, d].
    block_products
        X ↦ (H_k x_k)_k, [K, d] to [K, d].
    half_products
        v ↦ the mean of H_k v over each half, [d] to [d].
    model_covariance_product
        v ↦ Bv, the covariance of g_k that the policy's probabilities imply, [d] to [d].
    """

    gradients: Tensor
    block_products: Operator
    half_products: tuple[Operator, Operator]
    model_covariance_product: Operator

    @classmethod
    def from_matrices(cls, gradients: Tensor, hessians: Tensor, implied: Tensor) -> BatchMeans:
        """Return the sample of known g_k [K, d], symmetric H_k [K, d, d] and B [d, d]."""
        even, odd = hessians[0::2].mean(0), hessians[1::2].mean(0)
        return cls(
            gradients,
            lambda vectors: torch.einsum("kij,kj->ki", hessians, vectors),
            (lambda vector: even @ vector, lambda vector: odd @ vector),
            lambda vector: implied @ vector,
        )

    @classmethod
    def from_episodes(
        cls,
        policy: ActorCriticPolicy,
        actor: ActorParameters,
        batch: EpisodeBatch,
        n_blocks: int,
        gamma: float,
        rng: np.random.Generator,
    ) -> BatchMeans:
        """Deal the episodes at random into ``n_blocks`` blocks of equally many.

        At random, because episodes come in the order in which they ended, which tells of their
        lengths.
        """
        batch = batch.take(rng.permutation(batch.n_episodes))
        blocks = [
            EpisodeDerivatives(policy, actor, part, UNBIASED) for part in batch.split(n_blocks)
        ]
        even, odd = (EpisodeDerivatives(policy, actor, part, UNBIASED) for part in batch.split(2))
        sample = cls(
            torch.stack([block.gradient() for block in blocks]),
            lambda vectors: torch.stack(
                [block.hessian_product(x) for block, x in zip(blocks, vectors, strict=True)]
            ),
            (even.hessian_product, odd.hessian_product),
            model_covariance(policy, actor, batch, n_blocks, gamma),
        )
        return sample.to_dense() if sample.size <= DENSE else sample

    def to_dense(self) -> BatchMeans:
        """Return the same sample with its Hessians as matrices."""
        identity = torch.eye(self.size, dtype=torch.float64, device=self.gradients.device)
        hessians = torch.stack([self.products(column) for column in identity], dim=2)
        implied = torch.stack([self.model_covariance_product(column) for column in identity], dim=1)
        return self.from_matrices(
            self.gradients, 0.5 * (hessians + hessians.transpose(1, 2)), implied
        )

    def with_ticks(self, tick: Tick) -> BatchMeans:
        """Return the same sample, which tells of each product with the Hessian of its episodes."""

        def ticking(operator: Operator) -> Operator:
            def product(vector: Tensor) -> Tensor:
                tick(1)
                return operator(vector)

            return product

        even, odd = self.half_products
        return replace(
            self,
            block_products=ticking(self.block_products),
            half_products=(ticking(even), ticking(odd)),
        )

    @property
    def n_blocks(self) -> int:
        """The number of blocks, K."""
        return self.gradients.shape[0]

    @property
    def size(self) -> int:
        """The number of parameters, d."""
        return self.gradients.shape[1]

    def products(self, vector: Tensor) -> Tensor:
        """Return H_k v for all blocks, [K, d]."""
        return self.block_products(vector.expand(self.n_blocks, -1))

    def mean_product(self, vector: Tensor) -> Tensor:
        """Return Ĥv, [d]."""
        return 0.5 * (self.half_products[0](vector) + self.half_products[1](vector))

    def moment_products(self, vector: Tensor) -> tuple[Tensor, Tensor]:
        """Return Ĥv and V̂v, V̂ = Σ_k (H_k - Ĥ)² / (K - 1), at the cost of two products, [d] each.

        (H_k - Ĥ)v is multiplied by H_k alone: Ĥ times the sum of these is zero.
        """
        products = self.products(vector)
        mean = products.mean(0)
        return mean, self.block_products(products - mean).sum(0) / (self.n_blocks - 1)
