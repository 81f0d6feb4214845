"""The least curvature that the spread of the estimates allows, over all directions."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.optimize import minimize_scalar
from torch import Tensor

from sb3_crpn.arrays import FloatArray
from sb3_crpn.sosp.batch_means import BatchMeans

# Krylov steps on V̂, all directions tried, and the part of the interval's width that the last
# residual may take
_CHAIN, _MAX_DIRECTIONS, _TOLERANCE = 4, 20, 0.02


def worst_curvature(
    sample: BatchMeans, leftmost: Tensor, random: Tensor, multiplier: float
) -> float:
    r"""Return a lower bound on min_v [vᵀĤv - τ √(vᵀV̂v)] over unit vectors, as tight as can be.

    Since √x = min_c (x/c + c)/2, each μ > 0 bounds it from below by

    .. math:: \lambda_{\min}(\hat H - \mu\hat V) - \frac{\tau^2}{4\mu},

    which is concave in μ and whose maximum is the minimum sought: the pairs (vᵀĤv, vᵀV̂v) form a
    convex set for d ≥ 3 (Brickman, Proc. AMS 12, 1961). The eigenvalue comes from a subspace, of
    Ĥ's ``leftmost`` vector and a Krylov chain of V̂ from a ``random`` one, which shows where the
    noise is; the subspace grows by its own residuals (Davidson's method), and the last residual is
    subtracted. -∞ where all H_k vanish: no episode has shown anything.
    """
    space = _Space(sample)
    space.extend(leftmost)
    space.extend(random)
    for _ in range(_CHAIN):
        space.extend(space.images()[2][:, -1])
    while True:
        basis, mean, variance = space.images()
        if not mean.any() and not variance.any():
            return -math.inf
        H, V = basis.T @ mean, basis.T @ variance
        mu, penalty = _best_weight(H.cpu().numpy(), V.cpu().numpy(), multiplier)
        values, rotation = torch.linalg.eigh(H - mu * V)
        y = rotation[:, 0]
        residual = (mean - mu * variance) @ y - values[0] * (basis @ y)
        size = float(torch.linalg.vector_norm(residual))
        bound = float(values[0]) - penalty
        width = float(torch.linalg.eigvalsh(H)[0]) - bound
        rounding = 1e-12 * float(torch.linalg.matrix_norm(H))
        if size <= max(_TOLERANCE * width, rounding) or not space.extend(residual):
            return bound - size


class _Space:
    """A growing orthonormal basis Q [d, k] with ĤQ and V̂Q."""

    def __init__(self, sample: BatchMeans) -> None:
        self._sample = sample
        self._columns: list[tuple[Tensor, Tensor, Tensor]] = []

    def images(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return Q, ĤQ and V̂Q, [d, k] each."""
        basis, mean, variance = (torch.stack(c, dim=1) for c in zip(*self._columns, strict=True))
        return basis, mean, variance

    def extend(self, vector: Tensor) -> bool:
        """Add the part of ``vector`` outside the space; ``False`` if there is none, or no room."""
        size = torch.linalg.vector_norm(vector)
        for _ in range(2):  # twice is enough (Kahan, in Parlett 1980)
            for column, _, _ in self._columns:
                vector = vector - (column @ vector) * column
        outside = torch.linalg.vector_norm(vector)
        if outside <= 1e-10 * size or len(self._columns) == _MAX_DIRECTIONS:
            return False
        vector = vector / outside
        self._columns.append((vector, *self._sample.moment_products(vector)))
        return True


def _best_weight(H: FloatArray, V: FloatArray, multiplier: float) -> tuple[float, float]:
    """Return the μ that maximises λ_min(H - μV) - τ²/(4μ), and τ²/(4μ); zeros without noise."""
    largest = float(np.linalg.eigvalsh(V)[-1])
    if largest <= (1e-12 * np.linalg.norm(H)) ** 2:
        return 0.0, 0.0
    # μ = τ/(2s) for a worst direction of standard deviation s, at most √largest
    lowest = multiplier / (2.0 * math.sqrt(largest))

    def negative(log_ratio: float) -> float:
        mu = lowest * math.exp(log_ratio)
        return multiplier**2 / (4.0 * mu) - float(np.linalg.eigvalsh(H - mu * V)[0])

    found = minimize_scalar(negative, bounds=(0.0, math.log(1e6)), method="bounded")
    mu = lowest * math.exp(found.x)
    return mu, multiplier**2 / (4.0 * mu)
