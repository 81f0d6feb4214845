"""Estimates of ∇J, ∇²J and the Fisher matrix from whole episodes, as linear operators."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Literal

import torch
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_crpn.arrays import IntArray
from sb3_crpn.curvature.derivatives import EpisodeDerivatives
from sb3_crpn.curvature.operator import GroupedOperator, require_finite
from sb3_crpn.curvature.pair_weights import HessianEstimator
from sb3_crpn.curvature.shrinkage import relative_noise
from sb3_crpn.episodes.batch import EpisodeBatch, episode_chunks
from sb3_crpn.parameters import ActorParameters

# Groups whose disagreement measures the noise: two give an unbiased estimate of it, and more of
# them would run smaller, less efficient products.
N_GROUPS = 2

# Steps of one graph on a CPU: enough to be efficient, few enough for its cache. With 100,000 steps
# a Hessian product took 0.93 times as long as in two graphs, a Fisher product 0.85 times. A GPU
# waits for its kernels to be launched, and gets one graph a group.
CPU_CHUNK_STEPS = 4096


class EpisodeFolds:
    """The trajectories of all ranks, split round-robin into K folds; this rank holds a part.

    K = 2, or 1 where there is only one episode.

    Parameters
    ----------
    policy, actor, batch, estimator
        As for :class:`EpisodeDerivatives`; ``batch`` holds this rank's episodes, possibly none.
    max_steps
        The folds are sums over chunks of episodes, on a CPU of at most ``CPU_CHUNK_STEPS`` steps.
        ``None``: the chunks' graphs are kept for every product. Otherwise they live for one
        product and hold at most so many steps.

    Attributes
    ----------
    size, n_steps
        The folds' ``unit``s and steps over all ranks, float64 [K].
    """

    def __init__(
        self,
        policy: ActorCriticPolicy,
        actor: ActorParameters,
        batch: EpisodeBatch,
        estimator: HessianEstimator,
        max_steps: int | None,
    ) -> None:
        folds = batch.folds(N_GROUPS)
        sizes = [[len(episodes), batch.lengths[episodes].sum()] for episodes in folds]
        n_episodes, self.n_steps = batch.total(torch.tensor(sizes, dtype=torch.float64)).T
        self.size = self.n_steps if batch.unit == "n_steps" else n_episodes
        self._total = batch.total
        self._zero = torch.zeros(len(actor), dtype=torch.float64, device=actor.device)

        def chunk(episodes: IntArray) -> Callable[[], EpisodeDerivatives]:
            def derivatives() -> EpisodeDerivatives:
                return EpisodeDerivatives(policy, actor, batch.take(episodes), estimator)

            return cache(derivatives) if max_steps is None else derivatives

        limit = batch.n_steps if max_steps is None else max_steps
        if actor.device.type == "cpu":
            limit = min(limit, CPU_CHUNK_STEPS)
        self._folds = [
            [chunk(episodes[part]) for part in episode_chunks(batch.lengths[episodes], limit)]
            for episodes in folds
        ]

    def gradients(self) -> torch.Tensor:
        """Return the gradient of each fold, [K, d]."""
        return self._total(self._terms(EpisodeDerivatives.gradient, "size", self._zero))

    def operator(
        self,
        product: Callable[[EpisodeDerivatives, torch.Tensor], torch.Tensor],
        unit: Literal["size", "n_steps"],
        form: Callable[[EpisodeDerivatives, torch.Tensor], torch.Tensor] | None = None,
    ) -> GroupedOperator:
        """Return the matrix B whose products, and forms VᵀBV, are means over ``unit``."""

        def products(vector: torch.Tensor) -> torch.Tensor:
            return self._terms(lambda chunk: product(chunk, vector), unit, self._zero)

        def forms(basis: torch.Tensor) -> torch.Tensor:
            zero = self._zero.new_zeros(basis.shape[1], basis.shape[1])
            return self._terms(lambda chunk: form(chunk, basis), unit, zero)  # type: ignore[misc]

        return GroupedOperator(
            len(self._zero),
            products,
            getattr(self, unit),
            None if form is None else forms,
            self._total,
        )

    def _terms(
        self,
        quantity: Callable[[EpisodeDerivatives], torch.Tensor],
        unit: Literal["size", "n_steps"],
        zero: torch.Tensor,
    ) -> torch.Tensor:
        """Return the terms that this rank adds to the folds' means of ``quantity``, [K, …].

        ``quantity`` is itself a mean over the episodes or the steps of what it is given.
        """
        sizes = getattr(self, unit).tolist()
        terms = [zero] * len(sizes)
        for k, chunks in enumerate(self._folds):
            for derivatives in chunks:
                part = derivatives()
                terms[k] = terms[k] + quantity(part) * (getattr(part.batch, unit) / sizes[k])
        return torch.stack(terms)


@dataclass(frozen=True, eq=False)
class CurvatureEstimate:
    """The local geometry of J at θ, estimated from episodes.

    Attributes
    ----------
    gradient
        g ≈ ∇J(θ), float64 [d].
    hessian
        H ≈ ∇²J(θ).
    fisher
        F, the policy's Fisher matrix, a mean over steps and over the action's components.
    gradient_noise
        Estimate of E‖g - ∇J‖² / ‖g‖², from the disagreement of groups; nan for one episode.
    gradient_batch
        The episodes of g.
    """

    gradient: torch.Tensor
    hessian: GroupedOperator
    fisher: GroupedOperator
    gradient_noise: float
    gradient_batch: EpisodeBatch

    def __repr__(self) -> str:
        """Return one line."""
        norm = float(torch.linalg.vector_norm(self.gradient))
        return (
            f"CurvatureEstimate(d = {len(self.gradient)}, ‖g‖ = {norm:.3g}, "
            f"noise {self.gradient_noise:.0%} of ‖g‖²)"
        )


def estimate_curvature(
    policy: ActorCriticPolicy,
    actor: ActorParameters,
    batch: EpisodeBatch,
    estimator: HessianEstimator,
    *,
    hessian_batch: EpisodeBatch | None = None,
    fisher_batch: EpisodeBatch | None = None,
    max_steps: int | None = None,
) -> CurvatureEstimate:
    """Estimate g, H and F as in DESIGN section 2.

    Parameters
    ----------
    policy, actor
        The policy at θ, in evaluation mode, and its actor's parameters.
    batch
        The m episodes of g.
    estimator
        Brings the pair weights of H.
    hessian_batch, fisher_batch
        The b episodes of H, and those of F; ``None``: the m of g, whose graphs then serve both.
    max_steps
        Most steps whose graphs are held at a time, but at least one episode; ``None``: all.

    Raises
    ------
    ValueError
        The gradient is not finite, here, or a product with H or F, where it is asked for.
    """
    others = [other for other in (hessian_batch, fisher_batch) if other is not None]
    if max_steps is not None and sum(each.n_steps for each in (batch, *others)) <= max_steps:
        max_steps = None

    def folds_of(other: EpisodeBatch | None) -> EpisodeFolds:
        if other is None:
            return folds
        return EpisodeFolds(policy, actor, other, estimator, max_steps)

    folds = EpisodeFolds(policy, actor, batch, estimator, max_steps)
    gradients = folds.gradients()
    shares = (folds.size / folds.size.sum()).to(gradients.device)
    hessian = folds_of(hessian_batch).operator(
        EpisodeDerivatives.hessian_product, "size", EpisodeDerivatives.quadratic_form
    )
    return CurvatureEstimate(
        gradient=require_finite("the gradient", shares @ gradients),
        hessian=hessian,
        fisher=folds_of(fisher_batch).operator(EpisodeDerivatives.fisher_product, "n_steps"),
        gradient_noise=relative_noise(gradients, shares),
        gradient_batch=batch,
    )
