r"""Confidence intervals for ‖∇J‖ and λ_min(∇²J).

Both are extremes of expectations over unit directions,

.. math:: \|\nabla J\| = \max_n n \cdot \nabla J, \qquad
          \lambda_{\min}(\nabla^2 J) = \min_v v^T \nabla^2 J\, v, \qquad \|n\| = \|v\| = 1,

and noise biases the extreme of an estimate outwards: ‖ĝ‖ is too large and λ_min(Ĥ) is too small.
Each interval has an outer limit on that side and an inner limit on the other.

- *Outer limit* (upper for ‖∇J‖, lower for λ_min). In the fixed true direction n the one-dimensional
  t interval holds: n·∇J ≤ n·ĝ + τ s(n). s(n) is the standard deviation of n·g_k over the K blocks,
  and τ = t_{K-1}/√K. Since n is unknown, the limit is robust: it is the maximum of the right side
  over all n. It covers whenever the t interval of the true direction does, for every d. For the
  Hessian, vᵀV̂v ≥ s(v)² bounds the variance of vᵀH_k v, V̂ = Σ_k (H_k - Ĥ)²/(K - 1).
- *Inner limit* (cross-fitting). One fold of the blocks estimates a direction. The other fold is
  independent of it and estimates n·∇J ≤ ‖∇J‖ or vᵀ∇²J v ≥ λ_min by a mean. Its limit is that of the
  studentised bootstrap, which allows for skewness. Each fold estimates the direction once, at half
  the error probability.

Rare actions may be absent from all episodes. The sample variance is then too small, and a nearly
deterministic policy seems stationary. The standard deviation of g_k is therefore at least that of
its model-based covariance (:func:`~sb3_crpn.sosp.model_covariance.model_covariance`). The standard
deviation of H_k is inflated by the same factor. Beyond a factor of 2 the limits of λ_min are
infinite.

The intervals of "bernstein" are balls around the estimates instead.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.stats import t as student

from sb3_crpn.arrays import FloatArray
from sb3_crpn.sosp.batch_means import BatchMeans
from sb3_crpn.sosp.robust import robust_lambda_min
from sb3_crpn.sosp.spectrum import Spectrum, lanczos_spectrum, largest_eigenvalue

N_RESAMPLES = 10_000

# Lanczos steps for the direction of a fold, which need not be exact
_FOLD_STEPS = 10

# λ_min has infinite limits where the model-based standard deviation of the gradient exceeds this
# multiple of the sample standard deviation
_MAX_INFLATION = 2.0


@dataclass(frozen=True)
class Interval:
    """An estimate with its lower and upper confidence limits."""

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
    """Return the intervals of ‖∇J‖ and λ_min(∇²J) from batch means.

    Each of the four limits has the error probability (1 - ``confidence``)/4.

    Parameters
    ----------
    sample
        g_k and H_k.
    spectrum
        Of Ĥ.
    confidence
        In (0, 1).
    generator, rng
        Of the Lanczos starts and of the resamples.
    """
    error = (1.0 - confidence) / 4.0
    quantile = float(student.isf(error, sample.n_blocks - 1)) / math.sqrt(sample.n_blocks)
    std = float(torch.linalg.matrix_norm(sample.gradients - sample.gradients.mean(0), 2))
    std /= math.sqrt(sample.n_blocks - 1)
    variance = largest_eigenvalue(sample.model_covariance_product, sample.gradients[0], generator)
    model_std = math.sqrt(variance)
    radius = quantile * max(std, model_std) if sample.gradients.any() else math.inf
    of_gradient = _gradient_interval(sample, radius, error, rng)
    if model_std > _MAX_INFLATION * std:
        return of_gradient, Interval(float(spectrum.leftmost[0]), -math.inf, math.inf)
    inflation = max(1.0, model_std / std) if std > 0.0 else 1.0
    return of_gradient, _curvature_interval(
        sample, spectrum, inflation, quantile, error, generator, rng
    )


def bernstein_intervals(
    sample: BatchMeans,
    spectrum: Spectrum,
    confidence: float,
    bounds: tuple[float, float],
    n_episodes: int,
) -> tuple[Interval, Interval]:
    """Return balls around ‖ĝ‖ and λ_min(Ĥ), each of error probability (1 - ``confidence``)/2.

    |‖ĝ‖ - ‖∇J‖| ≤ ‖ĝ - ∇J‖, and |λ_min(Ĥ) - λ_min(∇²J)| ≤ ‖Ĥ - ∇²J‖ by Weyl's inequality.
    ``bounds`` are M_1 and M_2 of one episode.
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
    r"""Return r with P(‖mean of n terms - expectation‖ ≥ r) ≤ ``error``.

    .. math:: P \le D \exp\Big(\frac{-n r^2/2}{M^2 + M r/3}\Big)

    The matrix Bernstein inequality (Tropp, Found. Comput. Math. 12, 2012, Theorems 1.4 and 1.6) for
    deviations of norm ≤ M, and hence variance ≤ M². D = ``dimensions`` is 2d for symmetric matrices
    and d + 1 for vectors. The formula is solved for r, without the paper's upper bound by 8/3.
    """
    exponent = math.log(dimensions / error) / n
    return bound * (exponent / 3.0 + math.sqrt((exponent / 3.0) ** 2 + 2.0 * exponent))


def _gradient_interval(
    sample: BatchMeans, radius: float, error: float, rng: np.random.Generator
) -> Interval:
    """Return the interval of ‖∇J‖ with the upper limit ‖ĝ‖ + ``radius``.

    max_n [n·ĝ + τ s(n)] ≤ ‖ĝ‖ + τ max_n s(n).
    """
    norm = float(torch.linalg.vector_norm(sample.gradients.mean(0)))
    lower = 0.0
    for fold in (0, 1):
        mean = sample.gradients[fold::2].mean(0)
        length = float(torch.linalg.vector_norm(mean))
        if length > 0.0:
            direction = mean / length
            variance = float(direction @ sample.model_covariance_product(direction))
            held_out = (sample.gradients[1 - fold :: 2] @ direction).cpu().numpy()
            std = math.sqrt(max(0.0, variance))
            limit = -bootstrap_upper_limit(-held_out, error / 2.0, rng, min_std=std)
            lower = max(lower, limit)
    return Interval(norm, min(lower, norm), norm + radius)


def _curvature_interval(
    sample: BatchMeans,
    spectrum: Spectrum,
    inflation: float,
    quantile: float,
    error: float,
    generator: torch.Generator,
    rng: np.random.Generator,
) -> Interval:
    """Return the interval of λ_min(∇²J), ``inflation`` times the standard deviations of H_k."""
    estimate = float(spectrum.leftmost[0])
    upper = math.inf
    for fold, product in enumerate(sample.fold_products):
        direction = lanczos_spectrum(
            product, spectrum.vector, generator, n_steps=_FOLD_STEPS
        ).vector
        held_out = (sample.products(direction) @ direction)[1 - fold :: 2].cpu().numpy()
        std = inflation * float(held_out.std(ddof=1))
        upper = min(upper, bootstrap_upper_limit(held_out, error / 2.0, rng, min_std=std))
    start = torch.randn(sample.size, generator=generator, dtype=torch.float64)
    lower = robust_lambda_min(
        sample, spectrum.vector, start.to(spectrum.vector), inflation * quantile
    )
    return Interval(estimate, min(lower, estimate - spectrum.residual), max(upper, estimate))


def bootstrap_upper_limit(
    values: FloatArray, error: float, rng: np.random.Generator, *, min_std: float = 0.0
) -> float:
    """Return the studentised bootstrap's upper limit for the mean of ``values``, [n].

    The limit is mean - q s/√n. s is the larger of the standard deviation and ``min_std``. q is the
    ``error``-quantile of (mean* - mean)/(s*/√n) over resamples. The limit is infinite for small n,
    where too many resamples consist of one value.

    References
    ----------
    Efron and Tibshirani, An Introduction to the Bootstrap, 1993, section 12.5.
    """
    n = len(values)
    mean, std = float(values.mean()), float(values.std(ddof=1))
    if std == 0.0:
        return mean + float(student.isf(error, n - 1)) * min_std / math.sqrt(n)
    resamples = values[rng.integers(n, size=(N_RESAMPLES, n))]
    with np.errstate(divide="ignore", invalid="ignore"):
        pivots = (resamples.mean(1) - mean) / (resamples.std(1, ddof=1) / math.sqrt(n))
    quantile = np.quantile(np.nan_to_num(pivots, nan=0.0), error, method="lower")
    return mean - float(quantile) * max(std, min_std) / math.sqrt(n)
