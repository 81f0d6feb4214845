"""Shrinkage of the Hessian: the factor ω that multiplies H in the cubic model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch

from sb3_crpn.checks import FRACTION
from sb3_crpn.curvature.registry import Registry


@runtime_checkable
class Shrinkage(Protocol):
    """ω in [0, 1], chosen once an update from Hessians of independent groups of episodes."""

    def factor(self, hessians: torch.Tensor, weights: torch.Tensor) -> float:
        """Return ω for H = Σ_k w_k H_k.

        Parameters
        ----------
        hessians
            H_k in coordinates where M = I, float64 [K, n, n].
        weights
            w_k, Σ w_k = 1, [K].
        """
        ...


@dataclass(frozen=True)
class Constant:
    """ω = ``value``, which needs no group: 1 leaves H as it is, 0 gives a first-order step."""

    value: float = 1.0

    def __post_init__(self) -> None:
        FRACTION("Constant: value", self.value)

    def factor(self, hessians: torch.Tensor, weights: torch.Tensor) -> float:
        """Return ``value``."""
        return self.value


@dataclass(frozen=True)
class JamesStein:
    """ω = max(0, 1 - E‖noise‖²_F / ‖H‖²_F), the noise measured by the groups' disagreement.

    The positive-part James-Stein factor (James and Stein, 1961). ω → 1 as the groups grow. From one
    group alone the noise cannot be measured; 0, a first-order step, is then the safe answer.
    """

    def factor(self, hessians: torch.Tensor, weights: torch.Tensor) -> float:
        """Return ω from at least two groups, 0 from one."""
        noise = relative_noise(hessians, weights)
        return 0.0 if math.isnan(noise) else max(0.0, 1.0 - noise)


SHRINKAGES: Registry[Shrinkage] = Registry(Shrinkage, {"auto": lambda _: JamesStein()})


def resolve_shrinkage(value: Shrinkage | str | float | None, algorithm: object) -> Shrinkage:
    """Return the object that ``value`` stands for: a number is constant, ``None`` is 1."""
    if value is None or isinstance(value, (int, float)):
        return Constant(1.0 if value is None else float(value))
    return SHRINKAGES.resolve(value, algorithm)


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
