"""Solvers of the cubic model ``m(s) = g·s + ½ sᵀHs + (α/6)‖s‖³``. The package knows no RL."""

from sb3_crpn.cubic.approximate import cubic_finalsolver, cubic_subsolver
from sb3_crpn.cubic.dense import solve_dense
from sb3_crpn.cubic.krylov import solve_krylov
from sb3_crpn.cubic.lanczos import krylov_basis, leftmost_eigenvalues
from sb3_crpn.cubic.step import CubicStep

__all__ = [
    "CubicStep",
    "cubic_finalsolver",
    "cubic_subsolver",
    "krylov_basis",
    "leftmost_eigenvalues",
    "solve_dense",
    "solve_krylov",
]
