"""Hessian estimators: the pair weights W_ij of DESIGN section 2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from sb3_crpn.arrays import FloatArray, IntArray
from sb3_crpn.checks import FRACTION
from sb3_crpn.curvature.registry import Registry
from sb3_crpn.episodes.batch import episode_scan, episode_starts


@runtime_checkable
class HessianEstimator(Protocol):
    """The symmetric pair weights W of H = E[Σ_ij W_ij σ_i σ_jᵀ + Σ_i A_i ∇²log π_i]."""

    def apply(self, cost_advantages: FloatArray, lengths: IntArray, u: FloatArray) -> FloatArray:
        """Return w_i = Σ_j W_ij u_j, the sum over j within the episode of i, [T] or [T, k].

        Parameters
        ----------
        cost_advantages
            A_i, [T], episodes end to end.
        lengths
            Steps of each episode, [E].
        u
            u_j, [T], or k such vectors, [T, k].
        """
        ...


@dataclass(frozen=True)
class Trajectory:
    """W_ij = ½(A_i + A_j): the symmetric part of the paper's estimator (Theorem 1)."""

    def apply(self, cost_advantages: FloatArray, lengths: IntArray, u: FloatArray) -> FloatArray:
        """Return Wu by two sums an episode."""
        A = _column(cost_advantages, u)
        return 0.5 * (A * _episode_totals(u, lengths) + _episode_totals(A * u, lengths))


@dataclass(frozen=True)
class Causal:
    """W_ij = κ^|i-j| A_max(i,j), κ = ``decay`` in [0, 1].

    κ = 1 is the Hessian of the DiCE objective (Foerster et al., ICML 2018) and of Furmston et al.,
    JMLR 2016; κ = 0 keeps the curvature of the per-step surrogate alone.
    """

    decay: float = 1.0

    def __post_init__(self) -> None:
        FRACTION("Causal: decay", self.decay)

    def apply(self, cost_advantages: FloatArray, lengths: IntArray, u: FloatArray) -> FloatArray:
        """Return Wu by two linear recursions."""
        A = _column(cost_advantages, u)
        # j ≤ i: A_i Σ κ^(i-j) u_j;  j > i: Σ κ^(j-i) A_j u_j
        past = episode_scan(u, self.decay, lengths)
        weighted = A * u
        future = episode_scan(weighted, self.decay, lengths, reverse=True) - weighted
        return A * past + future


HESSIAN_ESTIMATORS: Registry[HessianEstimator] = Registry(
    HessianEstimator,
    {
        "causal": lambda algorithm: Causal(algorithm.hessian_lambda),
        "trajectory": lambda _: Trajectory(),
    },
)


def _column(values: FloatArray, like: FloatArray) -> FloatArray:
    return values.reshape(-1, *[1] * (like.ndim - 1))


def _episode_totals(values: FloatArray, lengths: IntArray) -> FloatArray:
    """Return for each step the sum of ``values`` over its episode, [T] or [T, k]."""
    totals: FloatArray = np.add.reduceat(values, episode_starts(lengths), axis=0)
    return totals.repeat(lengths, axis=0)
