"""The spectrum of a symmetric operator by Lanczos: leftmost eigenpairs and spectral density."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sb3_crpn.arrays import FloatArray, Operator
from sb3_crpn.cubic import krylov_basis

# Products of one Lanczos run. On CartPole-v1, 64×64, the leftmost Ritz pair of an untrained and of
# two trained policies had a residual below 1e-6 of the spectrum's width after 20 products
N_STEPS = 20

# Products for λ_max of a covariance, which on CartPole-v1, 64×64, had then converged to six digits
_COVARIANCE_STEPS = 6


@dataclass(frozen=True, eq=False)
class Spectrum:
    r"""Leftmost eigenpair and spectral density of a symmetric A, [d, d], by Lanczos.

    The density is that of stochastic Lanczos quadrature (Golub and Meurant, Matrices, Moments and
    Quadrature with Applications, 2010, chapter 11). From a random start, the Ritz values θ_i and
    the squared first entries τ_i of the eigenvectors of the Lanczos matrix give

    .. math:: \tfrac1d \operatorname{tr} f(A) \approx \sum_i \tau_i f(\theta_i), \quad
              \sum_i \tau_i = 1,

    with equality in expectation over the start for polynomials f of degree < 2k. For d ≤ k the θ_i
    are the eigenvalues and τ_i = 1/d.

    Attributes
    ----------
    values, weights
        θ_i, ascending, and τ_i of all starts.
    leftmost
        The leftmost Ritz values, ascending. The first is accurate to ``residual``. The others are
        upper bounds of the eigenvalues.
    vector
        Unit Ritz vector v of the leftmost θ, [d].
    residual
        ‖Av - θv‖. An eigenvalue lies within this distance of θ.
    """

    values: FloatArray
    weights: FloatArray
    leftmost: FloatArray
    vector: Tensor
    residual: float

    def __repr__(self) -> str:
        """Return one line."""
        return (
            f"Spectrum({len(self.values)} Ritz values in "
            f"[{self.values[0]:.3g}, {self.values[-1]:.3g}], d = {len(self.vector)}, "
            f"leftmost to {self.residual:.1e})"
        )

    def density(self, points: FloatArray, width: float) -> FloatArray:
        """Return Σ_i τ_i N(x; θ_i, width²), the smoothed spectral density at the points x."""
        deviations = (points[:, None] - self.values) / width
        kernel = np.exp(-0.5 * deviations**2) / (width * np.sqrt(2.0 * np.pi))
        density: FloatArray = kernel @ self.weights
        return density


def lanczos_spectrum(
    operator: Operator,
    like: Tensor,
    generator: torch.Generator,
    *,
    n_steps: int = N_STEPS,
    n_probes: int = 1,
    n_leftmost: int = 1,
) -> Spectrum:
    """Run Lanczos with full reorthogonalisation ``n_probes`` times.

    Parameters
    ----------
    operator
        v ↦ Av, A symmetric, float64 [d] to [d].
    like
        A vector with the size, dtype and device of v.
    generator
        Generator of the random starts.
    n_steps
        k, products of each run. For d ≤ k one run spans ℝᵈ.
    n_probes
        Number of random starts. More starts smooth the density, and may find eigenvectors
        orthogonal to the first start.
    n_leftmost
        Maximum number of leftmost Ritz values.
    """
    if like.numel() <= n_steps:
        n_probes = 1
    runs = [_run(operator, like, generator, n_steps) for _ in range(n_probes)]
    values = np.concatenate([run.values for run in runs])
    order = np.argsort(values)
    best = min(runs, key=lambda run: run.values[0])
    return Spectrum(
        values=values[order],
        weights=np.concatenate([run.weights for run in runs])[order] / n_probes,
        leftmost=best.values[:n_leftmost],
        vector=best.vector,
        residual=best.residual,
    )


def largest_eigenvalue(operator: Operator, like: Tensor, generator: torch.Generator) -> float:
    """Return λ_max of a positive semidefinite operator, [d] to [d], by Lanczos."""
    negative = lanczos_spectrum(lambda v: -operator(v), like, generator, n_steps=_COVARIANCE_STEPS)
    return max(0.0, -float(negative.leftmost[0]))


def _run(operator: Operator, like: Tensor, generator: torch.Generator, n_steps: int) -> Spectrum:
    if like.numel() <= n_steps:
        basis = torch.eye(like.numel(), dtype=like.dtype, device=like.device)
        images = torch.stack([operator(column) for column in basis], dim=1)
    else:
        start = torch.randn(like.numel(), generator=generator, dtype=like.dtype).to(like.device)
        basis, images = krylov_basis(operator, start, n_steps)
    projected = basis.T @ images
    values, rotation = torch.linalg.eigh(0.5 * (projected + projected.T))
    # rotation[0] holds the start's components, since the start is the first basis vector. On all of
    # ℝᵈ each eigenvalue has the weight 1/d
    full = basis.shape[1] == like.numel()
    weights = torch.full_like(values, 1.0 / len(values)) if full else rotation[0] ** 2
    vector = basis @ rotation[:, 0]
    residual = images @ rotation[:, 0] - values[0] * vector
    return Spectrum(
        values.cpu().numpy(),
        weights.cpu().numpy(),
        values[:1].cpu().numpy(),
        vector,
        float(torch.linalg.vector_norm(residual)),
    )
