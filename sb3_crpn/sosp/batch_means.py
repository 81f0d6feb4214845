"""Batch means: independent estimates of ∇J and ∇²J from blocks of whole episodes."""

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

# Up to this d every block's Hessian is a matrix. Its d products are fewer than Lanczos and the
# interval limits take
_MAX_DENSE_SIZE = 16


@dataclass(frozen=True)
class BatchMeans:
    """K independent and identically distributed pairs (g_k, H_k) with means ∇J and ∇²J.

    K is even. Fold 0 holds the even blocks, fold 1 the odd ones. ĝ and Ĥ are the means over all
    blocks.

    Attributes
    ----------
    gradients
        g_k, float64 [K, d].
    block_products
        X ↦ (H_k x_k)_k, [K, d] to [K, d].
    fold_products
        v ↦ the mean of H_k v over each fold, [d] to [d].
    model_covariance_product
        v ↦ Bv, B the model-based covariance of g_k, [d] to [d].
    """

    gradients: Tensor
    block_products: Operator
    fold_products: tuple[Operator, Operator]
    model_covariance_product: Operator

    @classmethod
    def from_matrices(cls, gradients: Tensor, hessians: Tensor, covariance: Tensor) -> BatchMeans:
        """Return the batch means with g_k [K, d], symmetric H_k [K, d, d] and B [d, d]."""
        even, odd = hessians[0::2].mean(0), hessians[1::2].mean(0)
        return cls(
            gradients,
            lambda vectors: torch.einsum("kij,kj->ki", hessians, vectors),
            (lambda vector: even @ vector, lambda vector: odd @ vector),
            lambda vector: covariance @ vector,
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
        """Split the episodes at random into ``n_blocks`` blocks of equal size.

        The order of the batch is that in which episodes ended, and depends on their lengths. A
        random permutation makes the blocks identically distributed.
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
        return sample.to_dense() if sample.size <= _MAX_DENSE_SIZE else sample

    def to_dense(self) -> BatchMeans:
        """Return the same batch means with H_k and B as matrices."""
        identity = torch.eye(self.size, dtype=torch.float64, device=self.gradients.device)
        hessians = torch.stack([self.products(column) for column in identity], dim=2)
        covariance = [self.model_covariance_product(column) for column in identity]
        return self.from_matrices(
            self.gradients,
            0.5 * (hessians + hessians.transpose(1, 2)),
            torch.stack(covariance, dim=1),
        )

    def with_progress(self, tick: Tick) -> BatchMeans:
        """Return the same batch means. ``tick`` is called at each product with a Hessian."""

        def counted(operator: Operator) -> Operator:
            def product(vector: Tensor) -> Tensor:
                tick(1)
                return operator(vector)

            return product

        even, odd = self.fold_products
        return replace(
            self,
            block_products=counted(self.block_products),
            fold_products=(counted(even), counted(odd)),
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
        return 0.5 * (self.fold_products[0](vector) + self.fold_products[1](vector))

    def moment_products(self, vector: Tensor) -> tuple[Tensor, Tensor]:
        """Return Ĥv and V̂v, V̂ = Σ_k (H_k - Ĥ)² / (K - 1), from two products, [d] each.

        Σ_k Ĥ(H_k - Ĥ)v = 0, hence (K - 1)V̂v = Σ_k H_k(H_k - Ĥ)v.
        """
        products = self.products(vector)
        mean = products.mean(0)
        return mean, self.block_products(products - mean).sum(0) / (self.n_blocks - 1)
