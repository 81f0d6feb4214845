"""What a cubic solver takes and returns: input checks, counted products, `CubicStep`."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]
ArrayLike = Tensor | NDArray[Any]
Operator = Callable[[Tensor], Tensor]

EPS = float(np.finfo(np.float64).eps)

# A residual below this multiple of EPS·(‖H‖+λ)·‖s‖ is rounding (DESIGN §4, by measurement)
ROUNDING = 10.0


@dataclass(frozen=True, eq=False)
class CubicStep:
    r"""A minimiser of the cubic model, exact or approximate, and what is known about it.

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
        How the solver ended, for people.
    lambda_min
        Leftmost (Ritz) value of H, relative to M, that the solver saw; NaN if it saw none.
    at_sosp
        Whether the model allows so small a decrease that the origin is an ε-second-order stationary
        point: the early termination of Maniyar et al., Algorithm 2. Other solvers leave it False.
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


class CountedOperator:
    """A user's ``v ↦ Hv`` that counts its calls and answers in v's dtype, on v's device.

    Raises
    ------
    ValueError
        If a product has another shape than v or is not finite.
    """

    def __init__(self, name: str, operator: Operator) -> None:
        self.name = name
        self.count = 0
        self._operator = operator

    def __call__(self, vector: Tensor) -> Tensor:
        """Return Hv."""
        self.count += 1
        product = torch.as_tensor(self._operator(vector)).detach().to(vector)
        if product.shape != vector.shape:
            raise ValueError(
                f"{self.name} returned shape {tuple(product.shape)}; "
                f"{tuple(vector.shape)}, the shape of its argument, is required"
            )
        _require_finite(f"the product of {self.name}", product)
        return product


def residual_limit(tol: float, gradient_norm: float, curvature: float, step_norm: float) -> float:
    """Return the largest residual that counts as zero; ``curvature`` is ‖H‖ + λ‖M‖ (DESIGN §4)."""
    return max(tol * gradient_norm, ROUNDING * EPS * curvature * step_norm)


def as_vector(name: str, value: ArrayLike) -> Tensor:
    """Return ``value`` as a finite float64 Tensor[d] on its own device, or raise ValueError."""
    vector = torch.as_tensor(value).detach().to(torch.float64)
    if vector.ndim != 1 or vector.numel() == 0:
        raise ValueError(f"{name} has shape {tuple(vector.shape)}; (d,) with d ≥ 1 is required")
    _require_finite(name, vector)
    return vector


def as_symmetric(name: str, value: ArrayLike, dim: int) -> Array:
    """Return the symmetric part of ``value`` as a finite array[dim, dim], or raise ValueError."""
    matrix = torch.as_tensor(value).detach().to("cpu", torch.float64)
    if matrix.shape != (dim, dim):
        raise ValueError(f"{name} has shape {tuple(matrix.shape)}; ({dim}, {dim}) is required")
    _require_finite(name, matrix)
    symmetric: Array = ((matrix + matrix.T) / 2).numpy()
    return symmetric


def positive(name: str, value: float) -> float:
    """Return ``value`` as a float if it is finite and > 0, or raise ValueError."""
    number = float(value)
    if not (math.isfinite(number) and number > 0):
        raise ValueError(f"{name} is {value!r}; a finite number > 0 is required")
    return number


def at_least(name: str, value: int, minimum: int) -> int:
    """Return ``value`` if it is an integer ≥ ``minimum``, or raise ValueError."""
    if value != int(value) or value < minimum:
        raise ValueError(f"{name} is {value!r}; an integer ≥ {minimum} is required")
    return int(value)


def random_unit_vector(like: Tensor, seed: int) -> Tensor:
    """Draw uniformly from the unit sphere of R^d, d, dtype and device as ``like``."""
    generator = torch.Generator().manual_seed(seed)
    vector = torch.randn(like.numel(), generator=generator, dtype=like.dtype).to(like.device)
    return vector / float(torch.linalg.vector_norm(vector))


def _require_finite(name: str, value: Tensor) -> None:
    finite = torch.isfinite(value)
    if not bool(finite.all()):
        bad = int((~finite).sum())
        raise ValueError(f"{name} has {bad} NaN or infinite entries; finite numbers are required")
