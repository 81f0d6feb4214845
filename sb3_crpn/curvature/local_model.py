"""The cubic model around θ, on all of ℝᵈ or on a subspace, in coordinates where M = I."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from sb3_crpn.cubic import krylov_basis
from sb3_crpn.curvature.estimate import (
    CurvatureEstimate,
    GroupedOperator,
    relative_noise,
    require_finite,
)
from sb3_crpn.distributed import all_sum


@dataclass(frozen=True)
class LocalModel:
    """m(y) = g·y + ½ yᵀ(ωH)y + (α/6)‖y‖³ on the steps s = basis · y, with ‖s‖_M = ‖y‖.

    Attributes
    ----------
    gradient
        g in these coordinates, [k].
    hessian
        H in these coordinates, [k, k], times ω; ``None`` when only products are known.
    product
        y ↦ ωH y.
    basis
        [d, k]; ``None`` for the identity.
    shrinkage
        ω.
    lambda_min
        Leftmost eigenvalue of H (not shrunk) on the basis, relative to M; nan when unknown.
    products
        Hessian-vector products spent on the model.
    """

    gradient: torch.Tensor
    hessian: torch.Tensor | None
    product: Callable[[torch.Tensor], torch.Tensor]
    basis: torch.Tensor | None
    shrinkage: float
    lambda_min: float
    products: int

    def to_parameters(self, coordinates: torch.Tensor) -> torch.Tensor:
        """Return the step s = basis · y, [d]."""
        return coordinates if self.basis is None else self.basis @ coordinates.to(self.basis)


def full_model(estimate: CurvatureEstimate, shrinkage: float) -> LocalModel:
    """Return the model on all of ℝᵈ in the Euclidean metric, H known by its products."""
    return LocalModel(
        gradient=estimate.gradient,
        hessian=None,
        product=lambda vector: shrinkage * (estimate.hessian @ vector),
        basis=None,
        shrinkage=shrinkage,
        lambda_min=float("nan"),
        products=0,
    )


def projected_model(
    estimate: CurvatureEstimate,
    *,
    damping: float | None,
    dim: int | None,
    shrinkage: float | None,
) -> LocalModel:
    """Return the model on a subspace, with its matrices written out, on the CPU.

    The subspace is ℝᵈ itself (``dim=None``), or the Krylov space K(H, g) of the Euclidean metric,
    or K(F, g) of the Fisher metric. On the last, H = 0 gives TRPO's natural-gradient step by
    ``dim`` conjugate-gradient iterations.

    Parameters
    ----------
    estimate
        g, H and F.
    damping
        ε of M = F + εI; ``None``: the Euclidean metric, M = I.
    dim
        Dimension of the Krylov space.
    shrinkage
        ω; ``None``: estimated by :func:`james_stein`.
    """
    basis, hessian_forms, fisher_form = _subspace(estimate, damping is not None, dim)
    # k × k matrices are slow work for a GPU
    gradient = (basis.T @ estimate.gradient).cpu()
    hessians = require_finite("the Hessian", all_sum(hessian_forms.cpu()))  # [K, k, k]
    if damping is not None:
        # VᵀFV = QΛQᵀ and s = VQ(Λ + ε)^(-½) y make the M-norm of s the Euclidean norm of y;
        # F ⪰ 0, so that a negative eigenvalue is rounding
        fisher = require_finite("the Fisher matrix", all_sum(fisher_form.cpu()))
        eigenvalues, vectors = torch.linalg.eigh(0.5 * (fisher + fisher.T))
        whiten = ((eigenvalues.clamp(min=0.0) + damping) ** -0.5)[:, None] * vectors.T
        basis = basis @ whiten.T.to(basis)
        gradient = whiten @ gradient
        hessians = whiten @ hessians @ whiten.T
    hessians = 0.5 * (hessians + hessians.transpose(1, 2))
    hessian = estimate.hessian.mean(hessians)
    omega = (
        james_stein(hessians, estimate.hessian.weights.to(hessians.device))
        if shrinkage is None
        else shrinkage
    )
    shrunk = omega * hessian
    return LocalModel(
        gradient=gradient,
        hessian=shrunk,
        product=lambda vector: shrunk @ vector,
        basis=basis,
        shrinkage=omega,
        lambda_min=float(torch.linalg.eigvalsh(hessian)[0]),
        products=basis.shape[1],
    )


def _subspace(
    estimate: CurvatureEstimate, fisher: bool, dim: int | None
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return an orthonormal basis V [d, k], and this rank's parts of VᵀH_k V [K, k, k] and VᵀFV.

    The basis comes with products with the operator that generates it; the other's are not needed.
    """
    recorder = _Recorder(estimate.fisher if fisher else estimate.hessian)
    if dim is None:
        size = estimate.hessian.shape[0]
        basis = torch.eye(size, dtype=torch.float64, device=estimate.gradient.device)
        forms = recorder.operator.group_forms(basis)
    else:
        basis = krylov_basis(recorder, _start(estimate.gradient), dim)
        forms = basis.T @ torch.stack(recorder.columns, dim=2)
    if not fisher:
        return basis, forms, torch.eye(basis.shape[1], dtype=torch.float64)
    return basis, estimate.hessian.group_forms(basis), estimate.fisher.mean(forms)


def _start(gradient: torch.Tensor) -> torch.Tensor:
    """Return the gradient, or a fixed random direction where it vanishes exactly."""
    if gradient.any():
        return gradient
    generator = torch.Generator().manual_seed(0)
    return torch.randn(len(gradient), dtype=torch.float64, generator=generator).to(gradient.device)


class _Recorder:
    """v ↦ Bv, keeping the groups' B_k v of every call."""

    def __init__(self, operator: GroupedOperator) -> None:
        self.operator = operator
        self.columns: list[torch.Tensor] = []

    def __call__(self, vector: torch.Tensor) -> torch.Tensor:
        products = self.operator.group_products(vector)
        self.columns.append(products)
        return require_finite("a product", all_sum(self.operator.mean(products)))


def james_stein(hessians: torch.Tensor, weights: torch.Tensor) -> float:
    """Return ω = max(0, 1 - E‖noise‖²_F / ‖H‖²_F), H = Σ_k w_k H_k, from groups H_k [K, k, k].

    The positive-part James-Stein factor (James and Stein, 1961) with the noise measured by the
    disagreement of the groups. ω → 1 as the groups grow. From one group alone the noise cannot be
    measured; 0, a first-order step, is then the safe answer.
    """
    noise = relative_noise(hessians, weights)
    return max(0.0, 1.0 - noise) if noise == noise else 0.0
