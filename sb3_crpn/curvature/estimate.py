"""Estimates of ∇J, ∇²J and the Fisher matrix from whole episodes, as linear operators."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Literal

import torch
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_crpn.arrays import IntArray
from sb3_crpn.curvature.derivatives import EpisodeDerivatives, PairWeights
from sb3_crpn.distributed import all_sum, gather_counts, rank
from sb3_crpn.episodes.batch import EpisodeBatch, episode_chunks, round_robin_split
from sb3_crpn.parameters import ActorParameters

# Groups whose disagreement measures the noise: two give an unbiased estimate of it, and more of
# them would run smaller, less efficient products.
N_GROUPS = 2

# Steps of one graph on a CPU: enough to be efficient, few enough for its cache. With 100,000 steps
# a Hessian product took 0.93 times as long as in two graphs, a Fisher product 0.85 times. A GPU
# waits for its kernels to be launched, and gets one graph a group.
CPU_CHUNK_STEPS = 4096

# VᵀBV of more columns is made from products, whose memory does not grow with columns × timesteps
MAX_FORM_COLUMNS = 128


class EpisodeFolds:
    """The episodes of all ranks, dealt in turn to K groups, of which this rank holds a part.

    K = 2, or 1 where there is only one episode.

    Parameters
    ----------
    policy, actor, batch, pair_weights
        As for :class:`EpisodeDerivatives`; ``batch`` holds this rank's episodes, possibly none.
    max_steps
        The groups are sums over runs of episodes, on a CPU of at most ``CPU_CHUNK_STEPS`` steps.
        ``None``: the runs' graphs are kept for every product. Otherwise they live for one product
        and hold at most so many steps.

    Attributes
    ----------
    n_episodes, n_steps
        Sizes of the groups over all ranks, float64 [K].
    """

    def __init__(
        self,
        policy: ActorCriticPolicy,
        actor: ActorParameters,
        batch: EpisodeBatch,
        pair_weights: PairWeights,
        max_steps: int | None,
    ) -> None:
        counts = gather_counts(batch.n_episodes)
        dealt = round_robin_split(
            batch.n_episodes, min(N_GROUPS, sum(counts)), first=sum(counts[: rank()])
        )
        own = [[len(episodes), batch.lengths[episodes].sum()] for episodes in dealt]
        self.n_episodes, self.n_steps = all_sum(torch.tensor(own, dtype=torch.float64)).T
        self._zero = torch.zeros(len(actor), dtype=torch.float64, device=actor.device)

        def run(episodes: IntArray) -> Callable[[], EpisodeDerivatives]:
            def open_run() -> EpisodeDerivatives:
                return EpisodeDerivatives(policy, actor, batch.take(episodes), pair_weights)

            return cache(open_run) if max_steps is None else open_run

        limit = batch.n_steps if max_steps is None else max_steps
        if actor.device.type == "cpu":
            limit = min(limit, CPU_CHUNK_STEPS)
        self._groups = [
            [run(episodes[part]) for part in episode_chunks(batch.lengths[episodes], limit)]
            for episodes in dealt
        ]

    def means(
        self,
        quantity: Callable[[EpisodeDerivatives], torch.Tensor],
        unit: Literal["n_episodes", "n_steps"],
        shape: tuple[int, ...] | None = None,
    ) -> torch.Tensor:
        """Return this rank's parts of the groups' means of ``quantity``, [K, d] or [K, *shape].

        The parts of all ranks add up to the means. ``quantity`` is itself a mean over the episodes
        or the steps of what it is given.
        """
        zero = self._zero if shape is None else self._zero.new_zeros(shape)
        return torch.stack(
            [
                self._mean(runs, quantity, unit, size, zero)
                for runs, size in zip(self._groups, getattr(self, unit).tolist(), strict=True)
            ]
        )

    def _mean(
        self,
        runs: list[Callable[[], EpisodeDerivatives]],
        quantity: Callable[[EpisodeDerivatives], torch.Tensor],
        unit: str,
        size: float,
        total: torch.Tensor,
    ) -> torch.Tensor:
        for open_run in runs:
            group = open_run()
            total = total + quantity(group) * (getattr(group.batch, unit) / size)
        return total


class GroupedOperator:
    """A symmetric d × d matrix B = Σ_k w_k B_k, known through its products B_k v.

    k runs over groups of whole episodes; Σ w_k = 1. ``operator @ v`` costs one product with each
    group. With several ranks a product is a sum over them: all must ask for it.

    Parameters
    ----------
    size
        d.
    group_products
        v ↦ this rank's parts of B_k v, float64 [d] to [K, d]; the parts of all ranks add up to
        B_k v.
    sizes
        What w_k is proportional to, [K]: the group's episodes, or its steps, over all ranks.
    group_forms
        V ↦ this rank's parts of VᵀB_k V, float64 [d, n] to [K, n, n], where there is a cheaper way
        to them than products for a few columns.
    """

    def __init__(
        self,
        size: int,
        group_products: Callable[[torch.Tensor], torch.Tensor],
        sizes: torch.Tensor,
        group_forms: Callable[[torch.Tensor], torch.Tensor] | None = None,
    ) -> None:
        self.shape = (size, size)
        self.group_products = group_products
        self.weights = sizes / sizes.sum()
        self._group_forms = group_forms

    def __matmul__(self, other: torch.Tensor) -> torch.Tensor:
        """Return B v for v of shape [d], or B V for V of shape [d, n]; float64.

        Raises
        ------
        ValueError
            Wrong shape, or the product is not finite.
        """
        other = torch.as_tensor(other, dtype=torch.float64)
        if other.shape[:1] != self.shape[:1] or other.ndim > 2:
            raise ValueError(
                f"operand has shape {tuple(other.shape)}, must be ({self.shape[1]},) "
                f"or ({self.shape[1]}, n)"
            )
        if other.ndim == 1:
            product = self.mean(self.group_products(other))
        else:
            columns = [self.mean(self.group_products(column)) for column in other.T]
            product = torch.stack(columns, dim=1)
        return require_finite("a product", all_sum(product))

    def group_forms(self, basis: torch.Tensor) -> torch.Tensor:
        """Return this rank's parts of VᵀB_k V for V = ``basis``, [d, n] to [K, n, n]."""
        if self._group_forms is not None and basis.shape[1] <= MAX_FORM_COLUMNS:
            return self._group_forms(basis)
        columns = [self.group_products(column) for column in basis.T]
        return basis.T @ torch.stack(columns, dim=2)

    def mean(self, groups: torch.Tensor) -> torch.Tensor:
        """Return Σ_k w_k x_k for x_k of any shape, [K, …] to […], on this rank alone."""
        mean: torch.Tensor = torch.tensordot(self.weights.to(groups.device), groups, dims=1)
        return mean

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
        F, the policy's Fisher matrix, a mean over steps and over the action's components.
    gradient_noise
        Estimate of E‖g - ∇J‖² / ‖g‖², from the disagreement of groups; nan for one episode.
    gradient_batch
        This rank's episodes of g.
    """

    gradient: torch.Tensor
    hessian: GroupedOperator
    fisher: GroupedOperator
    gradient_noise: float
    gradient_batch: EpisodeBatch


def estimate_curvature(
    policy: ActorCriticPolicy,
    actor: ActorParameters,
    gradient_batch: EpisodeBatch,
    hessian_batch: EpisodeBatch,
    pair_weights: PairWeights,
    max_steps: int | None = None,
    fisher_batch: EpisodeBatch | None = None,
) -> CurvatureEstimate:
    """Estimate g, H and F as in DESIGN section 2.

    Parameters
    ----------
    policy, actor
        The policy at θ, in evaluation mode, and its actor's parameters.
    gradient_batch, hessian_batch
        This rank's of the m episodes of g and of the b of H.
    pair_weights
        W of the Hessian estimator.
    max_steps
        Most steps whose graphs are held at a time, but at least one episode; ``None``: all.
    fisher_batch
        This rank's episodes of F; ``None``: the gradient's. Batches that are the same object, on
        every rank or on none, share their graphs.

    Raises
    ------
    ValueError
        The gradient is not finite, here, or a product with H or F, where it is asked for.
    """
    wanted = [
        gradient_batch,
        hessian_batch,
        gradient_batch if fisher_batch is None else fisher_batch,
    ]
    batches = {id(batch): batch for batch in wanted}
    if max_steps is not None and sum(batch.n_steps for batch in batches.values()) <= max_steps:
        max_steps = None
    groups = {
        key: EpisodeFolds(policy, actor, batch, pair_weights, max_steps)
        for key, batch in batches.items()
    }
    of_gradient, of_hessian, of_fisher = (groups[id(batch)] for batch in wanted)
    gradients = all_sum(of_gradient.means(EpisodeDerivatives.gradient, "n_episodes"))
    shares = (of_gradient.n_episodes / of_gradient.n_episodes.sum()).to(gradients.device)
    return CurvatureEstimate(
        gradient=require_finite("the gradient", shares @ gradients),
        hessian=GroupedOperator(
            len(actor),
            lambda v: of_hessian.means(lambda group: group.hessian_product(v), "n_episodes"),
            of_hessian.n_episodes,
            lambda V: of_hessian.means(
                lambda group: group.quadratic_form(V), "n_episodes", (V.shape[1], V.shape[1])
            ),
        ),
        fisher=GroupedOperator(
            len(actor),
            lambda v: of_fisher.means(lambda group: group.fisher_product(v), "n_steps"),
            of_fisher.n_steps,
        ),
        gradient_noise=relative_noise(gradients, shares),
        gradient_batch=gradient_batch,
    )


def require_finite(name: str, derivative: torch.Tensor) -> torch.Tensor:
    """Return ``derivative``, or raise ValueError where an entry is NaN or infinite.

    It is to be a sum over all ranks, so that all of them raise and none waits for another.
    """
    if not derivative.isfinite().all():
        raise ValueError(
            f"{name} is not finite: log π(a|s), or a derivative of it, overflows at the policy's "
            "parameters, as where the standard deviation of its actions has vanished. Training "
            "gets there by steps that are too long: raise alpha, or set target_kl"
        )
    return derivative


def relative_noise(groups: torch.Tensor, weights: torch.Tensor) -> float:
    """Return Σ_k w_k ‖x_k - x‖² / ((K - 1) ‖x‖²), x = Σ_k w_k x_k.

    An estimate of E‖x - E x‖² / ‖x‖² from the means x_k [K, …] of K independent groups whose
    sizes are as w_k. For K = 2 the numerator is w_1 w_2 ‖x_1 - x_2‖². nan when K = 1 or x = 0.
    """
    mean = torch.tensordot(weights, groups, dims=1)
    size = (mean**2).sum().item()
    if len(groups) < 2 or size == 0.0:
        return float("nan")
    spread = (weights * ((groups - mean) ** 2).flatten(1).sum(1)).sum().item()
    return float(spread / (len(groups) - 1) / size)
