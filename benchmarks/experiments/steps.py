"""Natural and regularised Newton steps of a given KL divergence, on a Krylov space of F."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy.optimize import brentq
from torch import Tensor

from sb3_crpn.cubic import krylov_basis
from sb3_crpn.curvature.derivatives import EpisodeDerivatives

# Relative accuracy of a step's length
TOLERANCE = 1e-6


@dataclass(frozen=True)
class Subspace:
    """The Krylov space K(F, g) in the coordinates y, s = basis · y, in which M = F + εI is I.

    Attributes
    ----------
    basis
        [d, k].
    fisher
        The diagonal of F, [k]: ½ Σ fisher · y² is the KL divergence of the step to second order.
    """

    basis: Tensor
    fisher: Tensor

    def length(self, y: Tensor) -> float:
        """Return √(sᵀFs), of which half the square is the KL divergence."""
        return float((self.fisher * y**2).sum().sqrt())

    def redamped(self, damping: float, other: float) -> tuple[Subspace, Tensor]:
        """Return the space in the coordinates of ε = ``other`` in place of ε = ``damping``.

        And the factors, [k], that a gradient's coordinates, and both sides of a Hessian's, take.
        """
        eigenvalues = damping * self.fisher / (1.0 - self.fisher)
        factors = ((eigenvalues + damping) / (eigenvalues + other)).sqrt()
        return Subspace(self.basis * factors, eigenvalues / (eigenvalues + other)), factors


def n_steps(groups: Sequence[EpisodeDerivatives]) -> Tensor:
    """Return the steps of each group, float64 [K]."""
    return torch.tensor([group.batch.n_steps for group in groups], dtype=torch.float64)


def gradient_sums(groups: Sequence[EpisodeDerivatives]) -> Tensor:
    """Return Σ_i A_i σ_i over the steps of each group, [K, d]."""
    return torch.stack([group.gradient() * group.batch.size for group in groups])


def hessian_sums(groups: Sequence[EpisodeDerivatives], basis: Tensor) -> Tensor:
    """Return VᵀHV of each group for V = ``basis``, summed over its steps, [K, k, k]."""
    forms = [group.quadratic_form(basis) * group.batch.size for group in groups]
    stacked = torch.stack(forms)
    return 0.5 * (stacked + stacked.transpose(1, 2))


def fisher_subspace(
    groups: Sequence[EpisodeDerivatives], gradient: Tensor, damping: float, dim: int
) -> Subspace:
    """Return K(F, g) with F from the states of all ``groups``."""
    shares = n_steps(groups) / n_steps(groups).sum()

    def product(vector: Tensor) -> Tensor:
        parts = torch.stack([group.fisher_product(vector) for group in groups])
        return shares @ parts

    basis, products = krylov_basis(product, gradient, dim)
    fisher = basis.T @ products
    eigenvalues, vectors = torch.linalg.eigh(0.5 * (fisher + fisher.T))
    eigenvalues = eigenvalues.clamp(min=0.0)
    metric = eigenvalues + damping
    return Subspace(basis @ vectors / metric.sqrt(), eigenvalues / metric)


def parabola_kl(slope: float, curvature: float) -> float:
    """Return ½ (slope/curvature)²; 0 if the cost increases, ∞ if it decreases without bound."""
    if slope <= 0.0:
        return 0.0
    return 0.5 * (slope / curvature) ** 2 if curvature > 0.0 else math.inf


def step_of_kl(gradient: Tensor, hessian: Tensor, space: Subspace, kl: float) -> Tensor:
    """Return the minimiser y of g·y + ½ yᵀHy + (α/6)‖y‖³ whose KL divergence is ``kl``.

    It is -(H + λI)⁻¹g with H + λI ⪰ 0. If the Newton step, λ = 0, is shorter, it is returned.
    """
    eigenvalues, vectors = torch.linalg.eigh(hessian)
    slopes = vectors.T @ gradient
    target = (2.0 * kl) ** 0.5

    def step(multiplier: float) -> Tensor:
        return -(vectors @ (slopes / (eigenvalues + multiplier)))

    # the smallest multiplier: the step is unbounded there, or Newton's
    scale = float(gradient.norm()) / target
    least = max(0.0, -float(eigenvalues[0])) + TOLERANCE * scale
    if space.length(step(least)) <= target:
        return step(least)
    largest = least + scale  # ‖y‖ ≤ ‖g‖/scale = target, and F-lengths are shorter than ‖y‖
    root = brentq(lambda m: space.length(step(m)) - target, least, largest, rtol=TOLERANCE)
    return step(root)
