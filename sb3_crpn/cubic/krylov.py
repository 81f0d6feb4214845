"""The cubic model with Hessian-vector products only: Lanczos and the secular equation."""

import math
from typing import NamedTuple

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from sb3_crpn.arrays import ArrayLike, FloatArray, Operator, as_vector
from sb3_crpn.checks import POSITIVE, SEED, integer
from sb3_crpn.cubic.lanczos import KrylovSpace
from sb3_crpn.cubic.secular import solve_secular
from sb3_crpn.cubic.step import (
    EPS,
    ROUNDING,
    CountedOperator,
    CubicStep,
    random_unit_vector,
    residual_limit,
)

# Bound on the probability that a certified step has missed a hidden negative curvature
_MISS_PROBABILITY = 1e-6

# The projected problem, O(k³), is solved anew every 1 + k/16 products: at most 6 % too many
_CHECK_EVERY = 16

# max_products=None: min(d, 1000) + 1. The space is all of R^d after d; 1000 vectors of d = 10⁵
# take 0.8 GB
_MAX_PRODUCTS = 1000


class _Minimiser(NamedTuple):
    """Minimiser of the model over the space: ``coordinates`` [k], its residual, what bounds it."""

    coordinates: FloatArray
    decrease: float
    residual: float
    limit: float
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
    127, §6.2), which grows until ``‖Hs + λs + g‖ ≤ max(tol‖g‖, 10·eps·(‖H‖+λ)‖s‖)``. This can
    be a saddle: the space holds no eigenvector orthogonal to g (hard case). A second chain with
    a random start sees them all; it grows until H + λI ⪰ 0 on what g cannot see is beyond doubt
    (`_curvature_is_known`). One explicit product confirms the residual.

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
        Most products spent, ≥ 2; None: min(d, 1000) + 1. Memory: 8·d bytes a product.
    seed
        Of the random start; the global generator is not touched.

    Returns
    -------
    CubicStep
        If the products ran out: the best step so far, ``certified`` False.

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
        max_products = min(g.numel(), _MAX_PRODUCTS) + 1
    # one is kept for the confirmation
    budget = integer(2)("solve_krylov: max_products", max_products) - 1
    gradient_norm = float(torch.linalg.vector_norm(g))

    space = KrylovSpace(CountedOperator("solve_krylov: hvp", hvp), g)
    if gradient_norm > 0:
        space.open(g)
    probe: int | None = None
    while True:
        point = _minimise(space, gradient_norm, alpha, tol)
        chain = _chain_with_largest_residual(space, point)
        if chain is None and not _curvature_is_known(space, probe, point.multiplier):
            if probe is None:
                probe = space.open(random_unit_vector(g, seed))
            chain = probe
        if chain is None or space.size >= budget:
            break
        for _ in range(min(budget - space.size, 1 + space.size // _CHECK_EVERY)):
            space.extend(chain)
    return _confirm(space, g, alpha, point, optimal=chain is None)


def _minimise(space: KrylovSpace, gradient_norm: float, alpha: float, tol: float) -> _Minimiser:
    """Solve the model projected on the space; no product."""
    if space.size == 0:
        return _Minimiser(np.zeros(0), 0.0, gradient_norm, 0.0, 0.0, math.nan)
    eigenvalues, V = scipy.linalg.eigh(space.projected, driver="evd")
    # the first basis vector is g/‖g‖, unless g = 0
    solution = solve_secular(eigenvalues, gradient_norm * V[0], alpha)
    y = V @ solution.coordinates
    norm = float(np.linalg.norm(y))
    multiplier = alpha / 2 * norm
    curvature = float(np.max(np.abs(eigenvalues))) + multiplier
    limit = residual_limit(tol, gradient_norm, curvature, norm)
    outside = torch.zeros_like(space.basis[0])
    for chain, end in zip(space.chains, space.ends, strict=True):
        if end is not None:
            outside += float(y[chain[-1]]) * end
    residual = float(torch.linalg.vector_norm(outside))
    return _Minimiser(y, solution.decrease, residual, limit, multiplier, float(eigenvalues[0]))


def _chain_with_largest_residual(space: KrylovSpace, point: _Minimiser) -> int | None:
    """Return the chain to extend for stationarity; None where the residual is small enough.

    Small enough is half the limit: the other half is for the rounding of the confirming product.
    """
    if point.residual <= point.limit / 2:
        return None
    shares = []
    for chain, end in zip(space.chains, space.ends, strict=True):
        last = abs(float(point.coordinates[chain[-1]])) if chain else 1.0
        shares.append(-1.0 if end is None else last * float(torch.linalg.vector_norm(end)))
    return int(np.argmax(shares))


def _curvature_is_known(space: KrylovSpace, probe: int | None, multiplier: float) -> bool:
    """Tell whether H + λI ⪰ 0 on what g cannot see, judged by the randomly started chain.

    True once the chain's leftmost Ritz pair (θ, v) has converged to rounding, or once a lower
    eigenvalue is improbable: Lanczos from a random start in R^d has after k steps
    P(θ - λ_1 ≥ ε(λ_d - λ_1)) ≤ 1.648 √d exp(-√ε(2k - 1))
    (Kuczyński & Woźniakowski 1992, SIAM J. Matrix Anal. Appl. 13, Theorem 4.2), and
    λ_1 < -λ would need ε ≥ (θ + λ)/(λ_d + λ). λ_d is the largest Ritz value.
    """
    if probe is None:
        return space.size == space.dim
    end, members = space.ends[probe], space.chains[probe]
    if end is None:
        return True
    ritz, V = scipy.linalg.eigh(space.projected[np.ix_(members, members)], driver="evd")
    error = float(torch.linalg.vector_norm(end)) * abs(V[-1, 0])
    if error <= ROUNDING * EPS * space.norm:
        return True
    if ritz[0] + multiplier <= 0:
        return False
    fraction = (ritz[0] + multiplier) / (ritz[-1] + multiplier)
    miss = 1.648 * math.sqrt(space.dim) * math.exp(-math.sqrt(fraction) * (2 * len(members) - 1))
    return miss <= _MISS_PROBABILITY


def _confirm(
    space: KrylovSpace, g: Tensor, alpha: float, point: _Minimiser, *, optimal: bool
) -> CubicStep:
    """Lift the minimiser to R^d and judge it by an explicit product."""
    coordinates = torch.from_numpy(point.coordinates).to(g.device)
    step = space.basis.T @ coordinates
    product = space.operator(step) if bool(step.any()) else torch.zeros_like(step)
    multiplier = alpha / 2 * float(torch.linalg.vector_norm(step))
    residual = float(torch.linalg.vector_norm(product + multiplier * step + g))
    exact = residual <= point.limit
    if not optimal:
        status = f"stopped at max_products: residual {residual:.1e}, wanted {point.limit:.1e}"
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
        certified=optimal and exact and semidefinite,
        status=status,
        lambda_min=point.lambda_min,
    )
