"""The cubic model around θ, on all of ℝᵈ or on a subspace, in coordinates where M = I."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch

from sb3_crpn.cubic import CubicStep
from sb3_crpn.curvature.estimate import CurvatureEstimate
from sb3_crpn.curvature.metric import Metric
from sb3_crpn.curvature.shrinkage import Shrinkage


class LocalModel(Protocol):
    """m(y) = g·y + ½ yᵀ(ωH)y + (α/6)‖y‖³ in coordinates y of steps s, with ‖s‖_M = ‖y‖."""

    @property
    def gradient(self) -> torch.Tensor:
        """The gradient g in these coordinates, float64 [n]."""
        ...

    @property
    def shrinkage(self) -> float:
        """The factor ω of the Hessian."""
        ...

    def product(self, coordinates: torch.Tensor) -> torch.Tensor:
        """Return ωH y, [n]."""
        ...

    def to_parameters(self, coordinates: torch.Tensor) -> torch.Tensor:
        """Return the step s of y, [d]."""
        ...

    def lambda_min(self, step: CubicStep) -> float:
        """Return the leftmost eigenvalue of H relative to M, as the model or the solver saw it."""
        ...

    @property
    def confirmed_lambda_min(self) -> float:
        """The curvature of other episodes along a leftmost eigenvector; nan where unknown."""
        ...

    def products(self, step: CubicStep) -> int:
        """Return the Hessian-vector products that the model and ``step`` cost."""
        ...


@dataclass(frozen=True, eq=False)
class FullModel:
    """The model on all of ℝᵈ in the Euclidean metric, H known by its products.

    Attributes
    ----------
    estimate
        g and H.
    shrinkage
        ω.
    """

    estimate: CurvatureEstimate
    shrinkage: float

    @property
    def gradient(self) -> torch.Tensor:
        """The gradient g, [d]."""
        return self.estimate.gradient

    def product(self, coordinates: torch.Tensor) -> torch.Tensor:
        """Return ωH y by one product."""
        return self.shrinkage * (self.estimate.hessian @ coordinates)

    def to_parameters(self, coordinates: torch.Tensor) -> torch.Tensor:
        """Return y."""
        return coordinates

    def lambda_min(self, step: CubicStep) -> float:
        """Return the leftmost Ritz value of ωH that the solver saw."""
        return step.lambda_min

    @property
    def confirmed_lambda_min(self) -> float:
        """nan: it would cost products."""
        return float("nan")

    def products(self, step: CubicStep) -> int:
        """Return the solver's products."""
        return step.products


@dataclass(frozen=True, eq=False)
class SubspaceModel:
    """The model on a subspace of n dimensions, its matrix written out on the CPU.

    Attributes
    ----------
    gradient
        g in the coordinates, [n].
    hessian
        ωH in the coordinates, [n, n].
    basis
        s = basis · y, [d, n].
    shrinkage
        ω.
    leftmost
        Leftmost eigenvalue of H (not shrunk) on the basis, relative to M.
    confirmed_lambda_min
        What is left of it in episodes that did not choose the eigenvector; nan from one group.
    """

    gradient: torch.Tensor
    hessian: torch.Tensor
    basis: torch.Tensor
    shrinkage: float
    leftmost: float
    confirmed_lambda_min: float

    def product(self, coordinates: torch.Tensor) -> torch.Tensor:
        """Return ωH y from the matrix."""
        return self.hessian @ coordinates

    def to_parameters(self, coordinates: torch.Tensor) -> torch.Tensor:
        """Return basis · y, [d]."""
        return self.basis @ coordinates.to(self.basis)

    def lambda_min(self, step: CubicStep) -> float:
        """Return ``leftmost``."""
        return self.leftmost

    def products(self, step: CubicStep) -> int:
        """Return the products that the basis cost, one a column; solving costs none."""
        return self.basis.shape[1]


def subspace_model(
    estimate: CurvatureEstimate, metric: Metric, shrinkage: Shrinkage, dim: int | None = None
) -> SubspaceModel:
    """Return the model on the Krylov space of the metric, or on ℝᵈ.

    Parameters
    ----------
    estimate
        g, H and F.
    metric
        M, and the operator that generates the Krylov space.
    shrinkage
        Chooses ω.
    dim
        Dimension of the Krylov space; ``None``: ℝᵈ itself, at the cost of d products.
    """
    operator, hessian = metric.generator(estimate), estimate.hessian
    if dim is None:
        basis = torch.eye(hessian.shape[0], dtype=torch.float64, device=estimate.gradient.device)
        forms = operator.group_forms(basis)
    else:
        basis, forms = operator.krylov(_start(estimate.gradient), dim)
    hessians = forms if operator is hessian else hessian.group_forms(basis)
    form = operator.mean(forms)
    # n × n matrices are slow work for a GPU: they are on the CPU
    W = metric.whitening(0.5 * (form + form.T))
    hessians = W @ hessians @ W.T
    hessians = 0.5 * (hessians + hessians.transpose(1, 2))
    mean = hessian.mean(hessians)
    omega = shrinkage.factor(hessians, hessian.weights.to(hessians.device))
    return SubspaceModel(
        gradient=W @ (basis.T @ estimate.gradient).cpu(),
        hessian=omega * mean,
        basis=basis @ W.T.to(basis),
        shrinkage=omega,
        leftmost=float(torch.linalg.eigvalsh(mean)[0]),
        confirmed_lambda_min=confirmed_minimum(hessians, hessian.weights.to(hessians.device)),
    )


def confirmed_minimum(hessians: torch.Tensor, weights: torch.Tensor) -> float:
    """Return Σ_k w_k u_kᵀ H_k u_k, u_k the leftmost eigenvector of Σ_{j≠k} w_j H_j.

    The smallest eigenvalue of a noisy matrix is too small: its eigenvector is chosen for the noise.
    The group k has not chosen u_k, so that for independent H_k this is the mean curvature of the
    true matrix along such eigenvectors. It is at least the true smallest eigenvalue, on average.

    Parameters
    ----------
    hessians
        H_k in coordinates where M = I, float64 [K, n, n]; nan for K = 1.
    weights
        w_k, Σ w_k = 1, [K].
    """
    if len(hessians) < 2:
        return float("nan")
    weighted = weights[:, None, None] * hessians
    vectors = torch.linalg.eigh(weighted.sum(0) - weighted).eigenvectors[:, :, 0]
    return float(torch.einsum("ki,kij,kj->", vectors, weighted, vectors))


def _start(gradient: torch.Tensor) -> torch.Tensor:
    """Return the gradient, or a fixed random direction where it vanishes exactly."""
    if gradient.any():
        return gradient
    generator = torch.Generator().manual_seed(0)
    return torch.randn(len(gradient), dtype=torch.float64, generator=generator).to(gradient.device)
