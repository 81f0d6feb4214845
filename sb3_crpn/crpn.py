"""CRPN: the cubic-regularised policy Newton method (Maniyar et al., Algorithm 1)."""

from __future__ import annotations

from typing import Literal

from sb3_crpn.algorithm import PolicyNewtonAlgorithm
from sb3_crpn.algorithm.declaration import configured, setting
from sb3_crpn.checks import choice
from sb3_crpn.cubic import CubicStep, solve_dense, solve_krylov
from sb3_crpn.curvature import LocalModel

# Up to this dimension d products for the whole Hessian are about as cheap as a Krylov space
DENSE_DIM = 64
# Relative residual of the Krylov solver: what products in float32 allow, far below the noise of g
KRYLOV_TOL = 1e-5


@configured
class CRPN(PolicyNewtonAlgorithm):
    """Cubic-Regularised Policy Newton: every step is a global minimiser of the cubic model.

    {parameters}
    """

    solver: Literal["auto", "dense", "krylov"] = setting(
        choice("auto", "dense", "krylov"),
        '"dense": the whole Hessian, d products, by eigendecomposition; "krylov": products only; '
        '"auto": dense up to d = 64.',
        "auto",
    )

    def _prefers_dense(self) -> bool:
        return self.solver == "dense" or (self.solver == "auto" and len(self.actor) <= DENSE_DIM)

    def _solve(self, model: LocalModel, alpha: float) -> CubicStep:
        if model.hessian is not None:
            return solve_dense(model.gradient, model.hessian, alpha)
        return solve_krylov(model.gradient, model.product, alpha, tol=KRYLOV_TOL)
