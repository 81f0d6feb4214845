r"""Confidence intervals for ‖∇J‖ and λ_min(∇²J).

Both are extremes over directions of means that episodes estimate one by one,

.. math:: \|\nabla J\| = \max_n n \cdot \nabla J, \qquad
          \lambda_{\min}(\nabla^2 J) = \min_v v^T \nabla^2 J\, v, \qquad \|n\| = \|v\| = 1,

and the extreme of an estimate is biased outwards: noise makes ‖ĝ‖ too large and λ_min(Ĥ) too small.
Each interval has one limit on that side and one on the other.

- *Outer limit* (upper for ‖∇J‖, lower for λ_min). The true n is one fixed direction, in which the
  one-dimensional t interval holds: n·∇J ≤ n·ĝ + τ s(n), where s(n) is the standard deviation of
  n·g_k over the K blocks and τ = t_{K-1}/√K. Since n is not known, the limit is taken in the worst
  direction: it covers whenever the t interval in the true one does, however large d is. For the
  Hessian s(v)² ≤ vᵀV̂v, V̂ = Σ_k (H_k - Ĥ)²/(K - 1), bounds the variance of vᵀH_k v.
- *Inner limit*. A direction learnt from one half of the blocks is independent of the other half,
  where it gives a plain mean, of n·∇J ≤ ‖∇J‖ or vᵀ∇²J v ≥ λ_min. Its limit is the studentised
  bootstrap's, which allows for skewness. Both halves have a turn, each at half the error.

Actions that a policy seldom takes may be missing from all episodes, which then agree, on wrong
values: a policy near to a deterministic one would look stationary. But their probabilities are
known. The spread of g_k is therefore taken to be no smaller than these imply
(:func:`~sb3_crpn.sosp.model_covariance.model_covariance`); that of H_k grows by the same factor,
and beyond a factor of 2 λ_min is given no limits.

The two-sided interval of "bernstein" is a ball around the estimate instead.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.stats import t as student

from sb3_crpn.arrays import FloatArray
from sb3_crpn.sosp.batch_means import BatchMeans
from sb3_crpn.sosp.robust import worst_curvature
from sb3_crpn.sosp.spectrum import Spectrum, lanczos_spectrum

N_RESAMPLES = 10_000

# Lanczos steps for a half's direction, which need not be exact, and for max_n nᵀBn; on CartPole-v1,
# 64×64, the latter had converged to six digits
_HALF_STEPS, _NORM_STEPS = 10, 6

# Nothing is said of the curvature where the gradient's implied spread is more than this times the
# sampled one
_UNSEEN = 2.0


@dataclass(frozen=True)
class Interval:
    """An estimate and the limits that its true value keeps with the stated confidence."""

    estimate: float
    lower: float
    upper: float

    def __str__(self) -> str:
        """Return "estimate [lower, upper]"."""
        return f"{self.estimate:.3g} [{self.lower:.3g}, {self.upper:.3g}]"

    def __repr__(self) -> str:
        """Return one line."""
        return f"Interval({self})"


def bootstrap_intervals(
    sample: BatchMeans,
    spectrum: Spectrum,
    confidence: float,
    generator: torch.Generator,
    rng: np.random.Generator,
) -> tuple[Interval, Interval]:
    """Return the intervals of ‖∇J‖ and λ_min(∇²J) from the spread over blocks.

    Each of the four limits fails with probability (1 - ``confidence``)/4.

    Parameters
    ----------
    sample
        g_k and H_k.
    spectrum
        Of Ĥ.
    confidence
        In (0, 1).
    generator, rng
        Of directions and of resamples.
    """
    error = (1.0 - confidence) / 4.0
    multiplier = float(student.isf(error, sample.n_blocks - 1)) / math.sqrt(sample.n_blocks)
    spread = float(torch.linalg.matrix_norm(sample.gradients - sample.gradients.mean(0), 2))
    spread /= math.sqrt(sample.n_blocks - 1)
    implied = _implied_spread(sample, generator)
    upper = multiplier * max(spread, implied) if sample.gradients.any() else math.inf
    of_gradient = _gradient_interval(sample, upper, error, rng)
    if implied > _UNSEEN * spread:
        return of_gradient, Interval(float(spectrum.leftmost[0]), -math.inf, math.inf)
    inflation = max(1.0, implied / spread) if spread > 0.0 else 1.0
    return of_gradient, _curvature_interval(
        sample, spectrum, inflation, multiplier, error, generator, rng
    )


def bernstein_intervals(
    sample: BatchMeans,
    spectrum: Spectrum,
    confidence: float,
    bounds: tuple[float, float],
    n_episodes: int,
) -> tuple[Interval, Interval]:
    """Return balls around ‖ĝ‖ and λ_min(Ĥ), each missed with probability (1 - ``confidence``)/2.

    |‖ĝ‖ - ‖∇J‖| ≤ ‖ĝ - ∇J‖ and |λ_min(Ĥ) - λ_min(∇²J)| ≤ ‖Ĥ - ∇²J‖ (Weyl). ``bounds`` are M_1 and
    M_2 of one episode.
    """
    error = (1.0 - confidence) / 2.0
    norm = float(torch.linalg.vector_norm(sample.gradients.mean(0)))
    of_gradient = bernstein_radius(bounds[0], n_episodes, sample.size + 1, error)
    estimate = float(spectrum.leftmost[0])
    of_hessian = bernstein_radius(bounds[1], n_episodes, 2 * sample.size, error)
    return (
        Interval(norm, max(norm - of_gradient, 0.0), norm + of_gradient),
        Interval(estimate, estimate - spectrum.residual - of_hessian, estimate + of_hessian),
    )


def bernstein_radius(bound: float, n: int, dimensions: int, error: float) -> float:
    """Return r with P(‖mean of n - expectation‖ ≥ r) ≤ ``error``.

    The matrix Bernstein inequality (Tropp, User-friendly tail bounds for sums of random matrices,
    Found. Comput. Math. 12, 2012, Theorem 1.4, 1.6): for deviations of norm ≤ M, and thus variance
    ≤ M², P ≤ D exp(-n r²/2 / (M² + Mr/3)), D = 2d for symmetric matrices and d + 1 for vectors.
    Solved for r, without the factor 8/3 by which the paper rounds it up.
    """
    exponent = math.log(dimensions / error) / n
    return bound * (exponent / 3.0 + math.sqrt((exponent / 3.0) ** 2 + 2.0 * exponent))


def _implied_spread(sample: BatchMeans, generator: torch.Generator) -> float:
    """Return the largest standard deviation of n·g_k that B implies."""
    negative = lanczos_spectrum(
        lambda vector: -sample.model_covariance_product(vector),
        sample.gradients[0],
        generator,
        n_steps=_NORM_STEPS,
    )
    return math.sqrt(max(0.0, -float(negative.leftmost[0])))


def _gradient_interval(
    sample: BatchMeans, radius: float, error: float, rng: np.random.Generator
) -> Interval:
    """Return the interval of ‖∇J‖ of which the upper limit is ``radius`` above ‖ĝ‖.

    max_n [n·ĝ + τ s(n)] ≤ ‖ĝ‖ + τ max_n s(n).
    """
    norm = float(torch.linalg.vector_norm(sample.gradients.mean(0)))
    lower = 0.0
    for half in (0, 1):
        learnt = sample.gradients[half::2].mean(0)
        length = float(torch.linalg.vector_norm(learnt))
        if length > 0.0:
            direction = learnt / length
            implied = float(direction @ sample.model_covariance_product(direction))
            held_out = (sample.gradients[1 - half :: 2] @ direction).cpu().numpy()
            spread = math.sqrt(max(0.0, implied))
            lower = max(lower, -upper_limit(-held_out, error / 2.0, rng, least_spread=spread))
    return Interval(norm, min(lower, norm), norm + radius)


def _curvature_interval(
    sample: BatchMeans,
    spectrum: Spectrum,
    inflation: float,
    multiplier: float,
    error: float,
    generator: torch.Generator,
    rng: np.random.Generator,
) -> Interval:
    """Return the interval of λ_min(∇²J), the spread of the H_k taken ``inflation`` times."""
    estimate = float(spectrum.leftmost[0])
    upper = math.inf
    for half, product in enumerate(sample.half_products):
        direction = lanczos_spectrum(
            product, spectrum.vector, generator, n_steps=_HALF_STEPS
        ).vector
        held_out = (sample.products(direction) @ direction)[1 - half :: 2].cpu().numpy()
        spread = inflation * float(held_out.std(ddof=1))
        upper = min(upper, upper_limit(held_out, error / 2.0, rng, least_spread=spread))
    start = torch.randn(sample.size, generator=generator, dtype=torch.float64)
    lower = worst_curvature(
        sample, spectrum.vector, start.to(spectrum.vector), inflation * multiplier
    )
    return Interval(estimate, min(lower, estimate - spectrum.residual), max(upper, estimate))


def upper_limit(
    values: FloatArray, error: float, rng: np.random.Generator, *, least_spread: float = 0.0
) -> float:
    """Return the studentised bootstrap's upper limit for the mean of ``values``, [n].

    mean - q s/√n, with q the ``error``-quantile of (mean* - mean)/(s*/√n) over resamples, and s the
    standard deviation or ``least_spread`` if larger. Infinite where too many resamples consist of
    one value: there are too few values for a limit.

    References
    ----------
    Efron and Tibshirani, An Introduction to the Bootstrap, 1993, section 12.5.
    """
    n = len(values)
    mean, spread = float(values.mean()), float(values.std(ddof=1))
    if spread == 0.0:
        return mean + float(student.isf(error, n - 1)) * least_spread / math.sqrt(n)
    resamples = values[rng.integers(n, size=(N_RESAMPLES, n))]
    with np.errstate(divide="ignore", invalid="ignore"):
        pivots = (resamples.mean(1) - mean) / (resamples.std(1, ddof=1) / math.sqrt(n))
    quantile = np.quantile(np.nan_to_num(pivots, nan=0.0), error, method="lower")
    return mean - float(quantile) * max(spread, least_spread) / math.sqrt(n)
