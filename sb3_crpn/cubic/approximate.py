"""The approximate solvers of ACRPN: Cauchy step and gradient descent on the cubic model.

Cubic-Subsolver and Cubic-Finalsolver of Maniyar et al. 2024 (AISTATS), Algorithm 2, after
Tripuraneni et al. 2018 (NeurIPS), Algorithms 3 and 4, with ρ = α, ℓ = ``gradient_lipschitz``,
ε = ``epsilon``. Where the code corrects the paper it says "Correction". O(d) memory: a handful of
vectors.
"""

import math
from typing import NamedTuple

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from sb3_crpn.arrays import ArrayLike, Operator, as_vector
from sb3_crpn.checks import COUNT, NONE, POSITIVE, SEED, real
from sb3_crpn.cubic.step import EPS, CountedOperator, CubicStep, random_unit_vector

# Step size 1/(20ℓ) (Tripuraneni et al. 2018, Algorithms 3 and 4)
_STEP_DIVISOR = 20

# Most gradient steps by default; the theory's N̂ is unbounded as ρε → 0
_MAX_STEPS = 10_000

# Lanczos products for ℓ: 10 gave 1.00 to 1.55 times ‖H‖, never less, on 900 random starts
# (uniform, decaying, outlying and semicircle spectra, d = 2 to 5000)
_LIPSCHITZ_PRODUCTS = 10

# The subsolver stops early where the gradient is below this part of σ/√d, the share of the
# perturbation that falls on one direction: a hidden direction would still show. The share is
# smaller with probability 0.1 %
_UNNOTICED = 1e-3


class _Descent(NamedTuple):
    """A step Δ, HΔ and how it was come by, for people."""

    step: Tensor
    product: Tensor
    status: str


def cubic_subsolver(
    gradient: ArrayLike,
    hvp: Operator,
    alpha: float,
    *,
    gradient_lipschitz: float | None = None,
    epsilon: float = 1e-2,
    max_steps: int | None = None,
    seed: int = 0,
) -> CubicStep:
    r"""Decrease the cubic model: Cubic-Subsolver.

    .. math:: m(s) = g \cdot s + \tfrac12 s^T H s + \tfrac\rho6 \|s\|^3

    A large gradient, ‖g‖ ≥ ℓ²/ρ, calls for the Cauchy step; otherwise gradient descent runs on
    the model of g̃ = g + σζ, ζ uniform on the unit sphere, so that it leaves saddles.

    Parameters
    ----------
    gradient
        g, [d].
    hvp
        v ↦ Hv, float64 Tensor[d] to Tensor[d].
    alpha
        ρ > 0. Correction: the paper admits 0, for which the model has no minimiser.
    gradient_lipschitz
        ℓ ≥ ‖H‖, ≥ 0; None: `estimate_lipschitz`, its products counted.
    epsilon
        ε > 0, the gradient norm sought, in the units of g.
    max_steps
        N̂ ≥ 1; None: ⌈20ℓ/√(ρε)·log(1 + 20√d·ℓ²/(ρε))⌉, at most 10 000.
    seed
        Of ζ; the global generator is not touched.

    Returns
    -------
    CubicStep
        ``predicted_decrease`` is of the model of g, not of g̃, and may be slightly negative.
        Never ``certified``: nothing is known of H + λI ⪰ 0.

    Raises
    ------
    ValueError
        For a wrong shape, a non-finite number (products included), α, ε ≤ 0, ℓ < 0, N̂ < 1.
    """
    g = as_vector("cubic_subsolver: gradient", gradient)
    rho, epsilon = (
        POSITIVE("cubic_subsolver: alpha", alpha),
        POSITIVE("cubic_subsolver: epsilon", epsilon),
    )
    operator = CountedOperator("cubic_subsolver: hvp", hvp)
    max_steps = (COUNT | NONE)("cubic_subsolver: max_steps", max_steps)
    given = (real(0.0) | NONE)("cubic_subsolver: gradient_lipschitz", gradient_lipschitz)
    seed = SEED("cubic_subsolver: seed", seed)
    # Correction: the paper supposes ℓ known; here it is estimated if not given
    lipschitz = estimate_lipschitz(operator, g) if given is None else given
    steps = _descent_steps(max_steps, lipschitz, rho, epsilon, g.numel())

    norm = float(torch.linalg.vector_norm(g))
    if rho * norm >= lipschitz**2:
        return _report(g, operator, rho, _cauchy_step(g, operator, rho))
    # Correction: σ = c'√(ερ)/ℓ, with a c' that the text lacks, is no gradient; ε√(ρε)/ℓ is one
    sigma = epsilon * math.sqrt(rho * epsilon) / lipschitz
    perturbed = g + sigma * random_unit_vector(g, seed)
    target = _UNNOTICED * sigma / math.sqrt(g.numel())
    descent = _descend(perturbed, operator, rho, lipschitz, target, steps)
    return _report(g, operator, rho, descent)


def cubic_finalsolver(
    gradient: ArrayLike,
    hvp: Operator,
    alpha: float,
    *,
    gradient_lipschitz: float | None = None,
    epsilon: float = 1e-2,
    max_steps: int | None = None,
) -> CubicStep:
    r"""Find a point where the cubic model's gradient is small: Cubic-Finalsolver.

    .. math:: \|\nabla m(s)\| = \|g + Hs + \tfrac\rho2\|s\|s\| \le \varepsilon/2

    Gradient descent from 0 with step 1/(20ℓ); where ‖g‖ > ℓ²/ρ, outside the paper's use of it,
    ℓ is replaced by √(ρ‖g‖), for which the steps are stable (ℓ = 0 included).

    Parameters, result and errors are those of `cubic_subsolver`; no randomness but in the
    estimate of ℓ.
    """
    g = as_vector("cubic_finalsolver: gradient", gradient)
    rho, epsilon = (
        POSITIVE("cubic_finalsolver: alpha", alpha),
        POSITIVE("cubic_finalsolver: epsilon", epsilon),
    )
    operator = CountedOperator("cubic_finalsolver: hvp", hvp)
    max_steps = (COUNT | NONE)("cubic_finalsolver: max_steps", max_steps)
    given = (real(0.0) | NONE)("cubic_finalsolver: gradient_lipschitz", gradient_lipschitz)
    # Correction: the paper supposes ℓ known; here it is estimated if not given
    lipschitz = estimate_lipschitz(operator, g) if given is None else given
    curvature = max(lipschitz, math.sqrt(rho * float(torch.linalg.vector_norm(g))))
    steps = _descent_steps(max_steps, curvature, rho, epsilon, g.numel())
    descent = _descend(g, operator, rho, curvature, epsilon / 2, steps)
    return _report(g, operator, rho, descent)


def estimate_lipschitz(
    hvp: Operator, like: Tensor, *, products: int = _LIPSCHITZ_PRODUCTS, seed: int = 0
) -> float:
    """Estimate ℓ = ‖H‖₂ by a few Lanczos products from a random start.

    Returns max|θ| + ‖r‖, θ the Ritz values and r the remainder of the last product: the
    safeguarded bound of Zhou & Li 2011 (Linear Algebra Appl. 435), which rarely falls below
    ‖H‖. Three vectors of memory, hence no reorthogonalisation.

    Parameters
    ----------
    hvp
        v ↦ Hv, Tensor[d] to Tensor[d].
    like
        A tensor of the dimension, dtype and device of v.
    products
        Most products spent, ≥ 1; fewer where the Krylov space is invariant before.
    seed
        Of the random start; the global generator is not touched.
    """
    products = COUNT("estimate_lipschitz: products", products)
    seed = SEED("estimate_lipschitz: seed", seed)
    operator = CountedOperator("estimate_lipschitz: hvp", hvp)
    q, previous = random_unit_vector(like, seed), torch.zeros_like(like)
    diagonal: list[float] = []
    off_diagonal: list[float] = [0.0]
    for _ in range(min(products, like.numel())):
        product = operator(q) - off_diagonal[-1] * previous
        diagonal.append(float(q @ product))
        product = product - diagonal[-1] * q
        beta = float(torch.linalg.vector_norm(product))
        off_diagonal.append(beta)
        if beta <= EPS * max(np.max(np.abs(diagonal)), np.max(off_diagonal[:-1])):
            break
        q, previous = product / beta, q
    ritz = scipy.linalg.eigh_tridiagonal(diagonal, off_diagonal[1:-1], eigvals_only=True)
    return float(np.max(np.abs(ritz))) + off_diagonal[-1]


def cauchy_radius(norm: float, curvature: float, rho: float) -> float:
    """Minimise ``-‖g‖R + ½hR² + (ρ/6)R³`` over R ≥ 0, ``curvature`` h = ĝᵀHĝ.

    The positive root of (ρ/2)R² + hR - ‖g‖, in the form without cancellation.
    """
    root = math.hypot(curvature, math.sqrt(2 * rho) * math.sqrt(norm))
    if curvature > 0:
        return 2 * norm / (curvature + root)
    return (root - curvature) / rho


def _cauchy_step(g: Tensor, operator: CountedOperator, rho: float) -> _Descent:
    """Minimise the model along -g: one product; none, and no step, where g = 0.

    Correction: Algorithm 2's R_c mixes ḡ and g, which is nowhere defined, and has ‖ḡ²‖ for ‖ḡ‖².
    """
    norm = float(torch.linalg.vector_norm(g))
    if norm == 0:
        return _Descent(
            torch.zeros_like(g),
            torch.zeros_like(g),
            "no step: gradient and gradient_lipschitz are 0",
        )
    direction = g / norm
    product = operator(direction)
    radius = cauchy_radius(norm, float(direction @ product), rho)
    return _Descent(-radius * direction, -radius * product, "Cauchy step")


def _descend(
    g: Tensor, operator: CountedOperator, rho: float, lipschitz: float, target: float, steps: int
) -> _Descent:
    """Run gradient descent on the model from 0 until ‖∇m‖ ≤ target; one product a step.

    Correction: the slope is ∇m = g + H[Δ] + (ρ/2)‖Δ‖Δ. The Finalsolver as printed,
    ḡ_J ← ḡ_J + H[Δ] + (ρ/2)‖Δ‖Δ, adds up the slopes of all iterates. It stops where the sum is
    small, if it does; ∇m is hardly ever small there.
    """
    step, product = torch.zeros_like(g), torch.zeros_like(g)
    # with ‖H‖ ≤ ℓ, m > 0 beyond the root of (ρ/6)R² = (ℓ/2)R + ‖g‖, and descent keeps m ≤ 0
    force = rho * float(torch.linalg.vector_norm(g))
    farthest = 3 / rho * (lipschitz / 2 + math.sqrt(lipschitz**2 / 4 + 2 / 3 * force))
    for count in range(steps + 1):
        norm = torch.linalg.vector_norm(step)
        slope = g + product + rho / 2 * norm * step
        if float(norm) > farthest:
            zero = torch.zeros_like(g)
            return _Descent(zero, zero, f"diverged: gradient_lipschitz < ‖H‖, {lipschitz:.3g} used")
        if float(torch.linalg.vector_norm(slope)) <= target:
            return _Descent(step, product, f"gradient descent: converged in {count} steps")
        if count < steps:
            step = step - slope / (_STEP_DIVISOR * lipschitz)
            product = operator(step)
    return _Descent(step, product, f"gradient descent: not converged in {steps} steps")


def _report(g: Tensor, operator: CountedOperator, rho: float, descent: _Descent) -> CubicStep:
    """Judge a step by the model of the unperturbed gradient."""
    step, product, status = descent
    norm = float(torch.linalg.vector_norm(step))
    multiplier = rho / 2 * norm
    return CubicStep(
        step=step,
        multiplier=multiplier,
        # -δ_J of Algorithm 2, J̄_k(θ_k) - J̄_k(θ_k + Δ): the model with ḡ, not with the perturbed g̃
        predicted_decrease=0.0 - float(g @ step + step @ product / 2) - rho / 6 * norm**3,
        products=operator.count,
        residual=float(torch.linalg.vector_norm(product + multiplier * step + g)),
        certified=False,
        status=status,
    )


def _descent_steps(
    given: int | None, lipschitz: float, rho: float, epsilon: float, dim: int
) -> int:
    """Return N̂.

    Correction: the paper's N̂ = 1/√ε lacks ℓ/√ρ, and with it has no units, and a logarithm. A
    direction of curvature -√(ρε) grows by 1 + √(ρε)/(20ℓ) a step, from the perturbation's share
    σ/(20ℓ√d) to the length √(ε/ρ) where the cubic term takes over.
    """
    if given is not None:
        return given
    ratio = lipschitz / math.sqrt(rho * epsilon)
    growth = math.log1p(_STEP_DIVISOR * math.sqrt(dim) * ratio**2)
    return max(1, min(_MAX_STEPS, math.ceil(_STEP_DIVISOR * ratio * growth)))
