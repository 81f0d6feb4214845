"""The approximate solvers of ACRPN: Cauchy step and gradient descent on the cubic model.

Cubic-Subsolver and Cubic-Finalsolver of Maniyar et al. 2024 (AISTATS), Algorithm 2, after
Tripuraneni et al. 2018 (NeurIPS), Algorithms 3 and 4. Symbols: ρ = ``alpha``,
ℓ = ``gradient_lipschitz``, ε = ``epsilon``, N̂ = ``max_steps``. A comment that begins with
"Correction" marks each place where the code corrects the paper. Memory is O(d).
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

# Upper limit of the default N̂, which grows without bound as ρε → 0
_MAX_STEPS = 10_000

# Lanczos products for ℓ. The estimate from 10 products was 1.00 to 1.55 times ‖H‖ on 900 random
# starts (uniform, decaying, outlying and semicircle spectra, d = 2 to 5000)
_LIPSCHITZ_PRODUCTS = 10

# The subsolver stops early once ‖∇m‖ is below this multiple of σ/√d. One component of the
# perturbation σζ has the size σ/√d, and is below the multiple with probability 0.1 %. A direction
# of negative curvature that only the perturbation excites therefore keeps ‖∇m‖ above it
_TOLERANCE = 1e-3


class _Problem(NamedTuple):
    """The checked arguments of both solvers: g, the operator H, ρ, ℓ, ε and N̂."""

    g: Tensor
    operator: CountedOperator
    rho: float
    lipschitz: float
    epsilon: float
    max_steps: int | None


class _Candidate(NamedTuple):
    """A step Δ, the product HΔ and the status of the solve."""

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

    The Cauchy step is taken where ‖g‖ ≥ ℓ²/ρ. Otherwise gradient descent runs on the model of the
    perturbed gradient g̃ = g + σζ, ζ uniform on the unit sphere. The perturbation lets the descent
    leave saddle points.

    Parameters
    ----------
    gradient
        g, [d].
    hvp
        v ↦ Hv, float64 Tensor[d] to Tensor[d].
    alpha
        ρ > 0. Correction: the paper admits ρ = 0, for which the model may have no minimiser.
    gradient_lipschitz
        ℓ ≥ ‖H‖, ≥ 0. None: the value of `estimate_lipschitz`; its products are counted.
    epsilon
        ε > 0, the tolerance of ‖∇J‖, in the units of g.
    max_steps
        N̂ ≥ 1. None: ⌈20ℓ/√(ρε)·log(1 + 20√d·ℓ²/(ρε))⌉, at most 10 000.
    seed
        Seed of ζ. PyTorch's global generator is not used.

    Returns
    -------
    CubicStep
        ``predicted_decrease`` refers to the model of g, not of g̃, and may be slightly negative.
        ``certified`` is always False: the solver does not test H + λI ⪰ 0.

    Raises
    ------
    ValueError
        For a wrong shape, a non-finite number (products included), α, ε ≤ 0, ℓ < 0, N̂ < 1.
    """
    name = "cubic_subsolver"
    seed = SEED(f"{name}: seed", seed)
    problem = _checked(name, gradient, hvp, alpha, gradient_lipschitz, epsilon, max_steps)
    g, _, rho, lipschitz, epsilon, _ = problem
    if rho * float(torch.linalg.vector_norm(g)) >= lipschitz**2:
        return _cubic_step(problem, _cauchy_step(problem))
    # Correction: the paper's σ = c'√(ερ)/ℓ has not the units of a gradient and leaves c' undefined.
    # ε√(ρε)/ℓ has them
    sigma = epsilon * math.sqrt(rho * epsilon) / lipschitz
    perturbed = problem._replace(g=g + sigma * random_unit_vector(g, seed))
    tolerance = _TOLERANCE * sigma / math.sqrt(g.numel())
    return _cubic_step(problem, _gradient_descent(perturbed, tolerance))


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

    Gradient descent from 0 with step size 1/(20ℓ). Where ‖g‖ > ℓ²/ρ, a case that Algorithm 2
    excludes, √(ρ‖g‖) replaces ℓ. The descent is then stable, also for ℓ = 0.

    Parameters, result and errors are those of `cubic_subsolver`. Only the estimate of ℓ is random.
    """
    name = "cubic_finalsolver"
    problem = _checked(name, gradient, hvp, alpha, gradient_lipschitz, epsilon, max_steps)
    norm = float(torch.linalg.vector_norm(problem.g))
    stable = problem._replace(lipschitz=max(problem.lipschitz, math.sqrt(problem.rho * norm)))
    return _cubic_step(problem, _gradient_descent(stable, problem.epsilon / 2))


def estimate_lipschitz(hvp: Operator, like: Tensor, *, seed: int = 0) -> float:
    """Estimate ℓ = ‖H‖₂ by at most ten Lanczos products from a random start.

    Returns max|θ| + ‖r‖, θ the Ritz values and r the residual vector of the last Lanczos step. It
    is the safeguarded bound of Zhou & Li 2011 (Linear Algebra Appl. 435), which is rarely below
    ‖H‖. Lanczos runs without reorthogonalisation, to keep three vectors only.

    Parameters
    ----------
    hvp
        v ↦ Hv, Tensor[d] to Tensor[d].
    like
        A tensor with the size, dtype and device of v.
    seed
        Seed of the random start. PyTorch's global generator is not used.
    """
    q, previous = random_unit_vector(like, seed), torch.zeros_like(like)
    diagonal: list[float] = []
    off_diagonal: list[float] = [0.0]
    for _ in range(min(_LIPSCHITZ_PRODUCTS, like.numel())):
        product = hvp(q) - off_diagonal[-1] * previous
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
    """Return the minimiser R ≥ 0 of ``-‖g‖R + ½hR² + (ρ/6)R³``, ``curvature`` h = ĝᵀHĝ.

    R is the positive root of (ρ/2)R² + hR - ‖g‖, in the form without cancellation.
    """
    root = math.hypot(curvature, math.sqrt(2 * rho) * math.sqrt(norm))
    if curvature > 0:
        return 2 * norm / (curvature + root)
    return (root - curvature) / rho


def _checked(
    name: str,
    gradient: ArrayLike,
    hvp: Operator,
    alpha: float,
    gradient_lipschitz: float | None,
    epsilon: float,
    max_steps: int | None,
) -> _Problem:
    """Check the arguments of the solver ``name``, and estimate ℓ if it is None."""
    g = as_vector(f"{name}: gradient", gradient)
    rho = POSITIVE(f"{name}: alpha", alpha)
    epsilon = POSITIVE(f"{name}: epsilon", epsilon)
    operator = CountedOperator(f"{name}: hvp", hvp)
    max_steps = (COUNT | NONE)(f"{name}: max_steps", max_steps)
    lipschitz = (real(0.0) | NONE)(f"{name}: gradient_lipschitz", gradient_lipschitz)
    if lipschitz is None:  # Correction: the paper supposes ℓ known
        lipschitz = estimate_lipschitz(operator, g)
    return _Problem(g, operator, rho, lipschitz, epsilon, max_steps)


def _cauchy_step(problem: _Problem) -> _Candidate:
    """Minimise the model along -g with one product; return 0 if g = 0.

    Correction: Algorithm 2's R_c contains an undefined g besides ḡ, and ‖ḡ²‖ in place of ‖ḡ‖².
    """
    g = problem.g
    norm = float(torch.linalg.vector_norm(g))
    if norm == 0:
        zero = torch.zeros_like(g)
        return _Candidate(zero, zero, "no step: gradient and gradient_lipschitz are 0")
    direction = g / norm
    product = problem.operator(direction)
    radius = cauchy_radius(norm, float(direction @ product), problem.rho)
    return _Candidate(-radius * direction, -radius * product, "Cauchy step")


def _gradient_descent(problem: _Problem, tolerance: float) -> _Candidate:
    """Run gradient descent on the model from 0 until ‖∇m‖ ≤ ``tolerance``; one product a step.

    Correction: the gradient is ∇m = g + H[Δ] + (ρ/2)‖Δ‖Δ. The Finalsolver as printed,
    ḡ_J ← ḡ_J + H[Δ] + (ρ/2)‖Δ‖Δ, adds up the gradients of all iterates. Where that sum is small,
    ∇m is rarely small.
    """
    g, operator, rho, lipschitz = problem[:4]
    max_steps = _max_steps(problem)
    step, product = torch.zeros_like(g), torch.zeros_like(g)
    # With ‖H‖ ≤ ℓ, m > 0 beyond the positive root of (ρ/6)R² = (ℓ/2)R + ‖g‖. Descent keeps m ≤ 0
    force = rho * float(torch.linalg.vector_norm(g))
    max_norm = 3 / rho * (lipschitz / 2 + math.sqrt(lipschitz**2 / 4 + 2 / 3 * force))
    for count in range(max_steps + 1):
        norm = torch.linalg.vector_norm(step)
        if not (math.isfinite(norm) and norm <= max_norm):
            zero = torch.zeros_like(g)
            status = f"diverged: gradient_lipschitz < ‖H‖, {lipschitz:.3g} used"
            return _Candidate(zero, zero, status)
        if count > 0:
            product = operator(step)
        model_gradient = g + product + rho / 2 * norm * step
        if float(torch.linalg.vector_norm(model_gradient)) <= tolerance:
            return _Candidate(step, product, f"descent converged in {count} steps")
        if count < max_steps:
            step = step - model_gradient / (_STEP_DIVISOR * lipschitz)
    return _Candidate(step, product, f"descent stopped at step {max_steps}")


def _max_steps(problem: _Problem) -> int:
    """Return N̂.

    Correction: the paper's N̂ = 1/√ε lacks the factor ℓ/√ρ, without which N̂ has units, and a
    logarithm. A direction of curvature -√(ρε) grows by the factor 1 + √(ρε)/(20ℓ) a step. It
    starts from the perturbation's component σ/(20ℓ√d). The cubic term stops it at √(ε/ρ).
    """
    if problem.max_steps is not None:
        return problem.max_steps
    ratio = problem.lipschitz / math.sqrt(problem.rho * problem.epsilon)
    growth = math.log1p(_STEP_DIVISOR * math.sqrt(problem.g.numel()) * ratio**2)
    return max(1, min(_MAX_STEPS, math.ceil(_STEP_DIVISOR * ratio * growth)))


def _cubic_step(problem: _Problem, candidate: _Candidate) -> CubicStep:
    """Evaluate the candidate by the model of the unperturbed gradient."""
    g, rho = problem.g, problem.rho
    step, product, status = candidate
    norm = float(torch.linalg.vector_norm(step))
    multiplier = rho / 2 * norm
    return CubicStep(
        step=step,
        multiplier=multiplier,
        # -δ_J of Algorithm 2, J̄_k(θ_k) - J̄_k(θ_k + Δ): the model with ḡ, not with the perturbed g̃
        predicted_decrease=0.0 - float(g @ step + step @ product / 2) - rho / 6 * norm**3,
        products=problem.operator.count,
        residual=float(torch.linalg.vector_norm(product + multiplier * step + g)),
        certified=False,
        status=status,
    )
