"""Statistics of independent runs with their bootstrap intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import bootstrap

CONFIDENCE = 0.95
N_RESAMPLES = 2000


class Estimate(NamedTuple):
    """A statistic, a float or an array, and the bounds of its interval."""

    value: Any
    low: Any
    high: Any


def interval(
    *samples: ArrayLike,
    statistic: Callable[..., Any] = np.mean,
    method: Literal["BCa", "percentile"] = "percentile",
    confidence: float = CONFIDENCE,
) -> Estimate:
    """Return a statistic of independent samples with its bootstrap interval.

    Where no sample varies the interval has width 0, unless each is of one value alone: then there
    is none (NaN).

    Parameters
    ----------
    samples
        Each is resampled separately.
    statistic
        Of as many samples as there are.
    method
        "percentile", or "BCa", bias-corrected and accelerated, for means of few skewed values
        (Efron, Better bootstrap confidence intervals, JASA 1987).
    confidence
        Of the interval.
    """
    data = tuple(np.asarray(sample, dtype=float) for sample in samples)
    value = float(statistic(*data))
    if all(len(sample) < 2 for sample in data):
        return Estimate(value, float("nan"), float("nan"))
    if all(np.ptp(sample) == 0 for sample in data):
        return Estimate(value, value, value)
    bounds = bootstrap(
        data,
        statistic,
        n_resamples=N_RESAMPLES,
        confidence_level=confidence,
        method=method,
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Estimate(value, float(bounds.low), float(bounds.high))


def difference_of_means(first: Sequence[float], second: Sequence[float]) -> float:
    """Return mean(first) - mean(second)."""
    return float(np.mean(first) - np.mean(second))


def ratio_of_medians(first: Sequence[float], second: Sequence[float]) -> float:
    """Return median(first) / median(second)."""
    return float(np.median(first) / np.median(second))
