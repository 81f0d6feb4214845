"""Robust λ_min: the lower confidence limit of the curvature, minimised over all directions."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.optimize import minimize_scalar
from torch import Tensor

from sb3_crpn.arrays import FloatArray
from sb3_crpn.sosp.batch_means import BatchMeans

# Krylov steps on V̂, the maximum dimension of the subspace, and the tolerance of the residual
# relative to the width of the interval
_KRYLOV_STEPS, _MAX_DIMENSION, _TOLERANCE = 4, 20, 0.02


def robust_lambda_min(
    sample: BatchMeans, leftmost: Tensor, random: Tensor, quantile: float
) -> float:
    r"""Return a lower bound on min_v [vᵀĤv - τ √(vᵀV̂v)] over unit vectors, τ = ``quantile``.

    Since √x = min_c (x/c + c)/2, each μ > 0 gives the lower bound

    .. math:: \lambda_{\min}(\hat H - \mu\hat V) - \frac{\tau^2}{4\mu},

    which is concave in μ. For d ≥ 3 its maximum over μ equals the minimum over v, since the pairs
    (vᵀĤv, vᵀV̂v) form a convex set (Brickman, Proc. AMS 12, 1961).

    λ_min is computed on a subspace by Davidson's method. The subspace starts with the ``leftmost``
    eigenvector of Ĥ and a Krylov space of V̂ from a ``random`` start, which covers directions of
    large variance. It is extended by its residuals. The norm of the last residual is subtracted
    from the bound. The result is -∞ if all H_k vanish, since such a sample carries no information.
    """
    space = _Subspace(sample)
    space.extend(leftmost)
    space.extend(random)
    for _ in range(_KRYLOV_STEPS):
        space.extend(space.images()[2][:, -1])
    while True:
        basis, mean, variance = space.images()
        if not mean.any() and not variance.any():
            return -math.inf
        H, V = basis.T @ mean, basis.T @ variance
        mu, penalty = _dual_maximiser(H.cpu().numpy(), V.cpu().numpy(), quantile)
        values, rotation = torch.linalg.eigh(H - mu * V)
        y = rotation[:, 0]
        residual = (mean - mu * variance) @ y - values[0] * (basis @ y)
        size = float(torch.linalg.vector_norm(residual))
        bound = float(values[0]) - penalty
        width = float(torch.linalg.eigvalsh(H)[0]) - bound
        rounding = 1e-12 * float(torch.linalg.matrix_norm(H))
        if size <= max(_TOLERANCE * width, rounding) or not space.extend(residual):
            return bound - size


class _Subspace:
    """A growing orthonormal basis Q [d, k] with ĤQ and V̂Q."""

    def __init__(self, sample: BatchMeans) -> None:
        self._sample = sample
        self._columns: list[tuple[Tensor, Tensor, Tensor]] = []

    def images(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return Q, ĤQ and V̂Q, [d, k] each."""
        basis, mean, variance = (torch.stack(c, dim=1) for c in zip(*self._columns, strict=True))
        return basis, mean, variance

    def extend(self, vector: Tensor) -> bool:
        """Add the orthogonal component of ``vector``. Return whether it is nonzero and fits in."""
        size = torch.linalg.vector_norm(vector)
        for _ in range(2):  # "twice is enough" (Kahan, in Parlett 1980)
            for column, _, _ in self._columns:
                vector = vector - (column @ vector) * column
        remainder = torch.linalg.vector_norm(vector)
        if remainder <= 1e-10 * size or len(self._columns) == _MAX_DIMENSION:
            return False
        vector = vector / remainder
        self._columns.append((vector, *self._sample.moment_products(vector)))
        return True


def _dual_maximiser(H: FloatArray, V: FloatArray, quantile: float) -> tuple[float, float]:
    """Return the maximiser μ of λ_min(H - μV) - τ²/(4μ), and τ²/(4μ). Both are 0 if V is 0."""
    largest = float(np.linalg.eigvalsh(V)[-1])
    if largest <= (1e-12 * np.linalg.norm(H)) ** 2:
        return 0.0, 0.0
    # μ = τ/(2s), s ≤ √largest the standard deviation in the minimising direction
    lowest = quantile / (2.0 * math.sqrt(largest))

    def negative_dual(log_ratio: float) -> float:
        mu = lowest * math.exp(log_ratio)
        return quantile**2 / (4.0 * mu) - float(np.linalg.eigvalsh(H - mu * V)[0])

    found = minimize_scalar(negative_dual, bounds=(0.0, math.log(1e6)), method="bounded")
    mu = lowest * math.exp(found.x)
    return mu, quantile**2 / (4.0 * mu)
