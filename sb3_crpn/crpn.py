"""CRPN: the cubic-regularised policy Newton method (Maniyar et al., Algorithm 1)."""

from __future__ import annotations

from sb3_crpn.algorithm import PolicyNewtonAlgorithm
from sb3_crpn.algorithm.declaration import configured, setting
from sb3_crpn.algorithm.solvers import SOLVERS, SubproblemSolver
from sb3_crpn.episodes import EpisodeBatch


@configured
class CRPN(PolicyNewtonAlgorithm):
    """Cubic-Regularised Policy Newton: every step is a global minimiser of the cubic model.

    {parameters}
    """

    solver: str | SubproblemSolver = setting(
        SOLVERS.check,
        '"dense": the whole Hessian, d products, by eigendecomposition; "krylov": products only; '
        '"auto": dense up to d = 64; or a :class:`~sb3_crpn.algorithm.solvers.SubproblemSolver`.',
        "auto",
    )

    def _update_solver(self, batch: EpisodeBatch) -> SubproblemSolver:
        return SOLVERS.resolve(self.solver, self)
