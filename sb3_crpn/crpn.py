"""CRPN: the cubic-regularised policy Newton method (Maniyar et al., Algorithm 1)."""

from __future__ import annotations

from typing import Any, Literal

from sb3_crpn.algorithm import PolicyNewtonAlgorithm
from sb3_crpn.algorithm.arguments import check_choice, inherits_arguments
from sb3_crpn.cubic import CubicStep, solve_dense, solve_krylov
from sb3_crpn.curvature import LocalModel

# Up to this dimension d products for the whole Hessian are about as cheap as a Krylov space
DENSE_DIM = 64
# Relative residual of the Krylov solver: what products in float32 allow, far below the noise of g
KRYLOV_TOL = 1e-5


class CRPN(PolicyNewtonAlgorithm):
    """Cubic-Regularised Policy Newton: every step is a global minimiser of the cubic model.

    Parameters
    ----------
    solver
        "dense": the whole Hessian, d products, by eigendecomposition; "krylov": products only;
        "auto": dense up to d = 64.
    **arguments
        Those of :class:`~sb3_crpn.algorithm.PolicyNewtonAlgorithm`.
    """

    @inherits_arguments(PolicyNewtonAlgorithm)
    def __init__(
        self, *args: Any, solver: Literal["auto", "dense", "krylov"] = "auto", **arguments: Any
    ) -> None:
        self.solver = solver
        super().__init__(*args, **arguments)

    def _setup_model(self) -> None:
        check_choice("solver", self.solver, ("auto", "dense", "krylov"))
        super()._setup_model()

    def _prefers_dense(self) -> bool:
        return self.solver == "dense" or (self.solver == "auto" and len(self.actor) <= DENSE_DIM)

    def _solve(self, model: LocalModel, alpha: float) -> CubicStep:
        if model.hessian is not None:
            return solve_dense(model.gradient, model.hessian, alpha)
        return solve_krylov(model.gradient, model.product, alpha, tol=KRYLOV_TOL)
