"""Metrics: the matrix M of the cubic term (α/6)‖s‖³_M (DESIGN section 3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch

from sb3_crpn.checks import POSITIVE
from sb3_crpn.curvature.estimate import CurvatureEstimate
from sb3_crpn.curvature.operator import GroupedOperator
from sb3_crpn.curvature.registry import Registry


@runtime_checkable
class Metric(Protocol):
    """A symmetric positive definite M, known on a subspace by the operator B that generates it."""

    def generator(self, estimate: CurvatureEstimate) -> GroupedOperator:
        """Return B: steps are sought in the Krylov space K(B, g)."""
        ...

    def whitening(self, form: torch.Tensor) -> torch.Tensor:
        """Return W with W(VᵀMV)Wᵀ = I, so that s = VWᵀy has ‖s‖_M = ‖y‖.

        Parameters
        ----------
        form
            VᵀBV for an orthonormal basis V of the subspace, symmetric, float64 [n, n].
        """
        ...


@dataclass(frozen=True)
class Euclidean:
    """M = I, the paper's; steps lie in K(H, g)."""

    def generator(self, estimate: CurvatureEstimate) -> GroupedOperator:
        """Return the Hessian."""
        return estimate.hessian

    def whitening(self, form: torch.Tensor) -> torch.Tensor:
        """Return I."""
        return torch.eye(len(form), dtype=form.dtype)


@dataclass(frozen=True)
class Fisher:
    """M = F + εI, ε = ``damping`` > 0; steps lie in K(F, g).

    There H = 0 gives TRPO's natural-gradient step, by as many conjugate-gradient iterations as the
    space has dimensions.
    """

    damping: float = 0.1

    def __post_init__(self) -> None:
        POSITIVE("Fisher: damping", self.damping)

    def generator(self, estimate: CurvatureEstimate) -> GroupedOperator:
        """Return the Fisher matrix."""
        return estimate.fisher

    def whitening(self, form: torch.Tensor) -> torch.Tensor:
        """Return (Λ + ε)^(-½)Qᵀ from VᵀFV = QΛQᵀ; a negative eigenvalue is rounding."""
        eigenvalues, vectors = torch.linalg.eigh(form)
        scale: torch.Tensor = (eigenvalues.clamp(min=0.0) + self.damping) ** -0.5
        whiten: torch.Tensor = scale[:, None] * vectors.T
        return whiten


METRICS: Registry[Metric] = Registry(
    Metric,
    {
        "euclidean": lambda _: Euclidean(),
        "fisher": lambda algorithm: Fisher(algorithm.fisher_damping),
    },
)
