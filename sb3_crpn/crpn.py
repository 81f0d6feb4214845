"""CRPN: the cubic-regularised policy Newton method (Maniyar et al., Algorithm 1)."""

from __future__ import annotations

from typing import Any

from sb3_crpn.algorithm import PolicyNewtonAlgorithm
from sb3_crpn.algorithm.arguments import inherits_arguments
from sb3_crpn.algorithm.solvers import SOLVERS, SubproblemSolver
from sb3_crpn.episodes import EpisodeBatch


class CRPN(PolicyNewtonAlgorithm):
    """Cubic-Regularised Policy Newton: every step is a global minimiser of the cubic model.

    Parameters
    ----------
    solver
        "dense": the whole Hessian, d products, by eigendecomposition; "krylov": products only;
        "auto": dense up to d = 64; or a :class:`~sb3_crpn.algorithm.solvers.SubproblemSolver`.
    **arguments
        Those of :class:`~sb3_crpn.algorithm.PolicyNewtonAlgorithm`.
    """

    @inherits_arguments(PolicyNewtonAlgorithm)
    def __init__(
        self, *args: Any, solver: str | SubproblemSolver = "auto", **arguments: Any
    ) -> None:
        self.solver = solver
        super().__init__(*args, **arguments)

    def _setup_model(self) -> None:
        SOLVERS.check("solver", self.solver)
        super()._setup_model()

    def _update_solver(self, batch: EpisodeBatch) -> SubproblemSolver:
        return SOLVERS.resolve(self.solver, self)
