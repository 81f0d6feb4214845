"""The cubic model with a dense Hessian: eigendecomposition and secular equation."""

import numpy as np
import scipy.linalg
import torch

from sb3_crpn.arrays import ArrayLike, FloatArray, as_symmetric, as_vector
from sb3_crpn.checks import POSITIVE
from sb3_crpn.cubic.secular import solve_secular
from sb3_crpn.cubic.step import EPS, ROUNDING, CubicStep, residual_tolerance

# Relative residual of a certified step, the default of solve_krylov
_TOL = 1e-8


def solve_dense(
    gradient: ArrayLike, hessian: ArrayLike, alpha: float, metric: ArrayLike | None = None
) -> CubicStep:
    r"""Minimise the cubic model globally, hard case included; O(d³), meant for d ≲ 2000.

    .. math:: \min_s\; g \cdot s + \tfrac12 s^T H s + \tfrac\alpha6 \|s\|_M^3

    V holds the eigenvectors of the pencil (H, M): VᵀHV = Λ and VᵀMV = I. In the coordinates y,
    s = Vy, the model is diagonal, and `solve_secular` minimises it (Cartis, Gould & Toint 2011,
    Math. Program. 127, §6.1).

    Parameters
    ----------
    gradient
        g, [d].
    hessian
        H, [d, d]. Its symmetric part is used.
    alpha
        α > 0, weight of the cubic term.
    metric
        M, [d, d], symmetric positive definite; None: the identity.

    Returns
    -------
    CubicStep
        ``products`` is 0. ``certified`` is False if rounding errors make the residual too large,
        which happens with a nearly singular metric.

    Raises
    ------
    ValueError
        For a wrong shape, a non-finite entry, α ≤ 0, or M not positive definite.
    """
    vector = as_vector("solve_dense: gradient", gradient)
    alpha = POSITIVE("solve_dense: alpha", alpha)
    g: FloatArray = vector.cpu().numpy()
    H = as_symmetric("solve_dense: hessian", hessian, len(g))
    M = None if metric is None else as_symmetric("solve_dense: metric", metric, len(g))

    eigenvalues, V = _eigh(H, M)
    gamma = V.T @ g
    solution = solve_secular(eigenvalues, gamma, alpha)
    s = V @ solution.coordinates
    Hs, Ms = H @ s, s if M is None else M @ s
    # ‖s‖_M = ‖y‖. sᵀMs has a relative rounding error of up to cond(M)·eps
    multiplier = alpha / 2 * float(np.linalg.norm(solution.coordinates))

    residual = float(np.linalg.norm(Hs + multiplier * Ms + g))
    # Norms are Euclidean, since the residual is computed and rounded in Euclidean coordinates
    curvature = float(
        np.linalg.norm(H, 1) + multiplier * (1.0 if M is None else np.linalg.norm(M, 1))
    )
    tolerance = residual_tolerance(
        _TOL, float(np.linalg.norm(g)), curvature, float(np.linalg.norm(s))
    )
    slack = ROUNDING * EPS * (float(np.max(np.abs(eigenvalues))) + multiplier)
    certified = bool(residual <= tolerance and multiplier + eigenvalues[0] >= -slack)
    return CubicStep(
        step=torch.from_numpy(s).to(vector.device),
        multiplier=multiplier,
        predicted_decrease=solution.decrease,
        products=0,
        residual=residual,
        certified=certified,
        status="global minimiser" if certified else f"rounding: residual {residual:.1e}",
        lambda_min=float(eigenvalues[0]),
    )


def _eigh(H: FloatArray, M: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Return Λ, ascending, and V of ``HV = MVΛ``. Divide and conquer is fast on clusters."""
    if M is None:
        eigenvalues, V = scipy.linalg.eigh(H, driver="evd")
        return eigenvalues, V
    try:
        eigenvalues, V = scipy.linalg.eigh(H, M, driver="gvd")
    except scipy.linalg.LinAlgError as error:
        raise ValueError(
            f"solve_dense: metric is not positive definite ({error}), must be"
        ) from error
    return eigenvalues, V
