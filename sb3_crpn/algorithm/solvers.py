"""Solvers of the cubic subproblem min_y m(y), as values."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch

from sb3_crpn.cubic import (
    CubicStep,
    cubic_finalsolver,
    cubic_subsolver,
    solve_dense,
    solve_krylov,
)
from sb3_crpn.curvature import LocalModel, Registry, SubspaceModel

# Up to this dimension d products for the whole Hessian are about as cheap as a Krylov space
DENSE_DIM = 64
# Relative residual of the Krylov solver: what products in float32 allow, far below the noise of g
KRYLOV_TOL = 1e-5


@runtime_checkable
class SubproblemSolver(Protocol):
    """Minimises the cubic model."""

    def needs_matrix(self, dim: int) -> bool:
        """Whether the model of ``dim`` = d parameters is to be a matrix on all of ℝᵈ."""
        ...

    def solve(self, model: LocalModel, alpha: float) -> CubicStep:
        """Return a minimiser of ``model`` for the coefficient α, in the model's coordinates."""
        ...


@dataclass(frozen=True)
class KrylovSolver:
    """The global minimiser, from products where the model has no matrix.

    ``tol`` is relative: ‖Hs + λs + g‖ ≤ tol ‖g‖.
    """

    tol: float = KRYLOV_TOL

    def needs_matrix(self, dim: int) -> bool:
        """Return False."""
        return False

    def solve(self, model: LocalModel, alpha: float) -> CubicStep:
        """Decompose the matrix of a subspace; else search a Krylov space."""
        if isinstance(model, SubspaceModel):
            return solve_dense(model.gradient, model.hessian, alpha)
        return solve_krylov(model.gradient, model.product, alpha, tol=self.tol)


@dataclass(frozen=True)
class DenseSolver(KrylovSolver):
    """The global minimiser by an eigendecomposition of the whole Hessian, at d products.

    Where d > ``max_dim`` it is a :class:`KrylovSolver`.
    """

    max_dim: float = math.inf

    def needs_matrix(self, dim: int) -> bool:
        """Return whether d ≤ ``max_dim``."""
        return dim <= self.max_dim


@dataclass(frozen=True)
class ApproximateSolver:
    """The Cubic-Subsolver and Cubic-Finalsolver of Maniyar et al., Algorithm 2.

    The Finalsolver runs where the Subsolver predicts less than the decrease (1/100)√(ε³/ρ), ρ = α,
    that any point other than an ε-second-order stationary point allows.

    Parameters
    ----------
    gradient_lipschitz
        ℓ ≥ ‖H‖; ``None``: estimated.
    epsilon
        ε > 0.
    max_steps
        N̂, iterations of either descent; ``None``: as the theory has it.
    seed
        Of the Subsolver's perturbation: one an update, whatever α is tried.
    """

    gradient_lipschitz: float | None
    epsilon: float
    max_steps: int | None
    seed: int

    def needs_matrix(self, dim: int) -> bool:
        """Return False."""
        return False

    def solve(self, model: LocalModel, alpha: float) -> CubicStep:
        """Return the Subsolver's step, or the Finalsolver's with ``at_sosp`` set."""
        lipschitz = self.gradient_lipschitz
        if lipschitz is None and isinstance(model, SubspaceModel):
            lipschitz = float(torch.linalg.matrix_norm(model.hessian, 2))
        problem = (model.gradient, model.product, alpha)
        cubic = cubic_subsolver(
            *problem,
            gradient_lipschitz=lipschitz,
            epsilon=self.epsilon,
            max_steps=self.max_steps,
            seed=self.seed,
        )
        if cubic.predicted_decrease > math.sqrt(self.epsilon**3 / alpha) / 100.0:
            return cubic
        final = cubic_finalsolver(
            *problem,
            gradient_lipschitz=lipschitz,
            epsilon=self.epsilon,
            max_steps=self.max_steps,
        )
        return replace(final, at_sosp=True)


SOLVERS: Registry[SubproblemSolver] = Registry(
    SubproblemSolver,
    {
        "auto": lambda _: DenseSolver(max_dim=DENSE_DIM),
        "dense": lambda _: DenseSolver(),
        "krylov": lambda _: KrylovSolver(),
    },
)
