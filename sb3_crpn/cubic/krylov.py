"""The cubic model with Hessian-vector products only: Lanczos and the secular equation."""

import math
from typing import NamedTuple

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from sb3_crpn.arrays import ArrayLike, FloatArray, Operator, as_vector
from sb3_crpn.checks import POSITIVE, SEED, integer
from sb3_crpn.cubic.lanczos import MAX_PRODUCTS, SOLVE_INTERVAL, KrylovSpace
from sb3_crpn.cubic.secular import solve_secular
from sb3_crpn.cubic.step import (
    EPS,
    ROUNDING,
    CountedOperator,
    CubicStep,
    random_unit_vector,
    residual_tolerance,
)

# Bound on the probability that a certified step misses an eigenvalue below -λ
_FAILURE_PROBABILITY = 1e-6


class _Minimiser(NamedTuple):
    """Minimiser of the model over the space.

    ``coordinates`` y [k], decrease -m(y), ‖residual‖, its tolerance, λ and the leftmost Ritz value.
    """

    coordinates: FloatArray
    decrease: float
    residual: float
    tolerance: float
    multiplier: float
    lambda_min: float


def solve_krylov(
    gradient: ArrayLike,
    hvp: Operator,
    alpha: float,
    *,
    tol: float = 1e-8,
    max_products: int | None = None,
    seed: int = 0,
) -> CubicStep:
    r"""Minimise the cubic model globally with Hessian-vector products only.

    .. math:: \min_s\; g \cdot s + \tfrac12 s^T H s + \tfrac\alpha6 \|s\|^3

    The model is minimised over the Krylov space of g (Cartis, Gould & Toint 2011, Math. Program.
    127, §6.2). The space grows until ``‖Hs + λs + g‖ ≤ max(tol‖g‖, 10·eps·(‖H‖+λ)‖s‖)``. Such a
    point may be a saddle, since the space contains no eigenvector orthogonal to g (hard case). A
    second Lanczos chain with a random start covers these eigenvectors. It grows until the leftmost
    eigenvalue is resolved (`_leftmost_is_resolved`). One explicit product confirms the residual.

    Parameters
    ----------
    gradient
        g, [d].
    hvp
        v ↦ Hv, H symmetric, float64 Tensor[d] to Tensor[d].
    alpha
        α > 0, weight of the cubic term.
    tol
        Residual relative to ‖g‖.
    max_products
        Maximum number of products, ≥ 2. None: min(d, 1000) + 1. Memory: 8·d bytes a product.
    seed
        Seed of the random start. PyTorch's global generator is not used.

    Returns
    -------
    CubicStep
        After ``max_products`` without convergence: the last minimiser, ``certified`` False.

    Raises
    ------
    ValueError
        For a wrong shape, a non-finite number (products included), α ≤ 0, tol ≤ 0,
        max_products < 2.
    """
    g = as_vector("solve_krylov: gradient", gradient)
    alpha, tol = POSITIVE("solve_krylov: alpha", alpha), POSITIVE("solve_krylov: tol", tol)
    seed = SEED("solve_krylov: seed", seed)
    if max_products is None:
        max_products = min(g.numel(), MAX_PRODUCTS) + 1
    # one product is reserved for the explicit residual
    budget = integer(2)("solve_krylov: max_products", max_products) - 1
    gradient_norm = float(torch.linalg.vector_norm(g))

    space = KrylovSpace(CountedOperator("solve_krylov: hvp", hvp), g)
    if gradient_norm > 0:
        space.start_chain(g)
    probe: int | None = None
    while True:
        point = _minimise(space, gradient_norm, alpha, tol)
        chain = _chain_with_largest_residual(space, point)
        if chain is None and not _leftmost_is_resolved(space, probe, point.multiplier):
            if probe is None:
                probe = space.start_chain(random_unit_vector(g, seed))
            chain = probe
        if chain is None or space.size >= budget:
            break
        for _ in range(min(budget - space.size, 1 + space.size // SOLVE_INTERVAL)):
            space.extend(chain)
    return _confirm(space, g, alpha, point, converged=chain is None)


def _minimise(space: KrylovSpace, gradient_norm: float, alpha: float, tol: float) -> _Minimiser:
    """Minimise the model over the space, without a product."""
    if space.size == 0:
        return _Minimiser(np.zeros(0), 0.0, gradient_norm, 0.0, 0.0, math.nan)
    eigenvalues, V = scipy.linalg.eigh(space.projected, driver="evd")
    # the first basis vector is g/‖g‖, unless g = 0
    solution = solve_secular(eigenvalues, gradient_norm * V[0], alpha)
    y = V @ solution.coordinates
    norm = float(np.linalg.norm(y))
    multiplier = alpha / 2 * norm
    curvature = float(np.max(np.abs(eigenvalues))) + multiplier
    tolerance = residual_tolerance(tol, gradient_norm, curvature, norm)
    residual = float(torch.linalg.vector_norm(space.residual(y)))
    lambda_min = float(eigenvalues[0])
    return _Minimiser(y, solution.decrease, residual, tolerance, multiplier, lambda_min)


def _chain_with_largest_residual(space: KrylovSpace, point: _Minimiser) -> int | None:
    """Return the chain that contributes most to the residual; None if the residual is small.

    The threshold is half the tolerance. The other half is left to the rounding of the product that
    confirms the residual.
    """
    if point.residual <= point.tolerance / 2:
        return None
    norms = []
    for chain, remainder in zip(space.chains, space.remainders, strict=True):
        last = abs(float(point.coordinates[chain[-1]])) if chain else 1.0
        size = -1.0 if remainder is None else float(torch.linalg.vector_norm(remainder))
        norms.append(last * size)
    return int(np.argmax(norms))


def _leftmost_is_resolved(space: KrylovSpace, probe: int | None, multiplier: float) -> bool:
    """Return whether the random chain resolves the leftmost eigenvalue λ_1 of H, or λ_1 ≥ -λ.

    Either the chain's leftmost Ritz pair (θ, v) has converged to rounding, or an eigenvalue below
    -λ is improbable. Lanczos from a random start in R^d has after k steps
    P(θ - λ_1 ≥ ε(λ_d - λ_1)) ≤ 1.648 √d exp(-√ε(2k - 1))
    (Kuczyński & Woźniakowski 1992, SIAM J. Matrix Anal. Appl. 13, Theorem 4.2). λ_1 < -λ implies
    ε ≥ (θ + λ)/(λ_d + λ). λ_d is taken to be the largest Ritz value.
    """
    if probe is None:
        return space.size == space.dim
    remainder, members = space.remainders[probe], space.chains[probe]
    if remainder is None:
        return True
    ritz, V = scipy.linalg.eigh(space.projected[np.ix_(members, members)], driver="evd")
    error = float(torch.linalg.vector_norm(remainder)) * abs(V[-1, 0])
    if error <= ROUNDING * EPS * space.norm:
        return True
    if ritz[0] + multiplier <= 0:
        return False
    fraction = (ritz[0] + multiplier) / (ritz[-1] + multiplier)
    exponent = -math.sqrt(fraction) * (2 * len(members) - 1)
    return 1.648 * math.sqrt(space.dim) * math.exp(exponent) <= _FAILURE_PROBABILITY


def _confirm(
    space: KrylovSpace, g: Tensor, alpha: float, point: _Minimiser, *, converged: bool
) -> CubicStep:
    """Map the minimiser to R^d and verify its residual by an explicit product."""
    coordinates = torch.from_numpy(point.coordinates).to(g.device)
    step = space.basis.T @ coordinates
    product = space.operator(step) if bool(step.any()) else torch.zeros_like(step)
    multiplier = alpha / 2 * float(torch.linalg.vector_norm(step))
    residual = float(torch.linalg.vector_norm(product + multiplier * step + g))
    exact = residual <= point.tolerance
    if not converged:
        status = f"stopped at max_products: residual {residual:.1e}, wanted {point.tolerance:.1e}"
    elif not exact:
        status = f"products are inexact: residual {residual:.1e}, expected {point.residual:.1e}"
    else:
        status = "global minimiser"
    slack = ROUNDING * EPS * (space.norm + multiplier)
    semidefinite = point.lambda_min + multiplier >= -slack
    return CubicStep(
        step=step,
        multiplier=multiplier,
        predicted_decrease=point.decrease,
        products=space.operator.count,
        residual=residual,
        certified=converged and exact and semidefinite,
        status=status,
        lambda_min=point.lambda_min,
    )
