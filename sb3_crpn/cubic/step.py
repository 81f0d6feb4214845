"""The input and the result of a cubic solver: `CountedOperator` and `CubicStep`."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sb3_crpn.arrays import Operator, require_finite
from sb3_crpn.checks import CALLABLE

EPS = float(np.finfo(np.float64).eps)

# A residual below this multiple of EPS·(‖H‖+λ)·‖s‖ is rounding (DESIGN §4, by measurement)
ROUNDING = 10.0


@dataclass(frozen=True, eq=False)
class CubicStep:
    r"""A minimiser of the cubic model, exact or approximate, with its optimality conditions.

    .. math:: m(s) = g \cdot s + \tfrac12 s^T H s + \tfrac{\alpha}{6} \|s\|_M^3

    s is a global minimiser iff, with λ = α‖s‖_M/2, ``(H + λM)s = -g`` and ``H + λM ⪰ 0``
    (Nesterov & Polyak 2006, Math. Program. 108, Theorem 10; Cartis, Gould & Toint 2011,
    Math. Program. 127, Theorem 3.1).

    Attributes
    ----------
    step
        s, Tensor[d], float64, on the gradient's device.
    multiplier
        λ = α‖s‖_M/2, in the units of H (relative to M).
    predicted_decrease
        m(0) - m(s), in the units of the objective.
    products
        Hessian-vector products spent.
    residual
        ‖Hs + λMs + g‖, Euclidean, from an explicit product.
    certified
        True only if both optimality conditions were verified to tolerance.
    status
        Why the solver stopped, as text.
    lambda_min
        Leftmost eigenvalue or Ritz value of H, relative to M. NaN if the solver computes none.
    at_sosp
        Whether the predicted decrease is below the threshold of Maniyar et al., Algorithm 2, at
        which the origin is an ε-second-order stationary point. Exact solvers leave it False.
    """

    step: Tensor
    multiplier: float
    predicted_decrease: float
    products: int
    residual: float
    certified: bool
    status: str
    lambda_min: float = math.nan
    at_sosp: bool = False

    def __repr__(self) -> str:
        """Return one line."""
        norm = float(torch.linalg.vector_norm(self.step))
        return (
            f"CubicStep({self.status}: ‖s‖ = {norm:.3g}, λ = {self.multiplier:.3g}, "
            f"decrease {self.predicted_decrease:.3g}, residual {self.residual:.1e}, "
            f"{self.products} products, {'' if self.certified else 'not '}certified)"
        )


class CountedOperator:
    """A user's ``v ↦ Hv``. It counts its calls and returns Hv with v's dtype and device.

    Raises
    ------
    ValueError
        The operator is not callable, or Hv has another shape than v or is not finite.
    """

    def __init__(self, name: str, operator: Operator) -> None:
        self.name = name
        self.count = 0
        self._operator: Operator = CALLABLE(name, operator)

    def __call__(self, vector: Tensor) -> Tensor:
        """Return Hv."""
        self.count += 1
        returned = self._operator(vector)
        try:
            product = torch.as_tensor(returned).detach().to(vector)
        except (TypeError, ValueError, RuntimeError):
            raise ValueError(f"{self.name} returned {returned!r}, must return a tensor") from None
        if product.shape != vector.shape:
            raise ValueError(
                f"{self.name} returned shape {tuple(product.shape)}, "
                f"must return that of its argument, {tuple(vector.shape)}"
            )
        require_finite(f"the product of {self.name}", product)
        return product


def residual_tolerance(
    tol: float, gradient_norm: float, curvature: float, step_norm: float
) -> float:
    """Return max(tol‖g‖, 10·eps·(‖H‖ + λ‖M‖)‖s‖) (DESIGN §4); ``curvature`` is ‖H‖ + λ‖M‖."""
    return max(tol * gradient_norm, ROUNDING * EPS * curvature * step_norm)


def random_unit_vector(like: Tensor, seed: int) -> Tensor:
    """Draw uniformly from the unit sphere of R^d, with the size, dtype and device of ``like``."""
    generator = torch.Generator().manual_seed(seed)
    vector = torch.randn(like.numel(), generator=generator, dtype=like.dtype).to(like.device)
    return vector / float(torch.linalg.vector_norm(vector))
