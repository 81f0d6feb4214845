"""Intervals and aggregates over seeds and environments, after Agarwal et al.

Deep Reinforcement Learning at the Edge of the Statistical Precipice, NeurIPS 2021 (rliable), whose
interquartile mean, performance profile, probability of improvement and stratified bootstrap these
are; every environment weighs the same here, however many seeds it has.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from benchmarks.common.intervals import CONFIDENCE, N_RESAMPLES, Estimate

Array = npt.NDArray[np.float64]


def stratified_bootstrap(
    samples: Sequence[Array], statistic: Callable[[Sequence[Array]], float | Array]
) -> Estimate:
    """Return a statistic with percentile bounds; seeds are resampled within each environment.

    The normalisation of the scores is taken as exact, as in rliable. Environments of one seed
    alone have no interval (NaN).
    """
    value = statistic(samples)
    if all(len(s) < 2 for s in samples):
        none = np.full_like(value, np.nan, dtype=float)
        return Estimate(value, none, none)
    rng = np.random.default_rng(0)
    resampled = [
        statistic([s[rng.integers(len(s), size=len(s))] for s in samples])
        for _ in range(N_RESAMPLES)
    ]
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(resampled, [tail, 1 - tail], axis=0)
    return Estimate(value, low, high)


def interquartile_mean(samples: Sequence[Array]) -> float:
    """Return the mean of the middle half of all scores.

    Scores carry weight 1 / (environments × seeds of the environment); those at the quartiles count
    with the part of their weight that lies between. With equally many seeds and a number of scores
    divisible by four it is ``scipy.stats.trim_mean(scores, 0.25)``.

    Parameters
    ----------
    samples
        The scores of each environment.
    """
    scores = np.concatenate(samples)
    weights = np.concatenate([np.full(len(s), 1 / len(s) / len(samples)) for s in samples])
    order = np.argsort(scores)
    upper = np.cumsum(weights[order])
    inside = np.clip(np.minimum(upper, 0.75) - np.maximum(upper - weights[order], 0.25), 0, None)
    return float(scores[order] @ inside / inside.sum())


def mean_score(samples: Sequence[Array]) -> float:
    """Return the mean over environments of the mean score over seeds."""
    return float(np.mean([np.mean(s) for s in samples]))


def performance_profile(samples: Sequence[Array], thresholds: Array) -> Array:
    """Return the fraction of runs that score above each threshold, a mean over environments."""
    return np.mean([(s[:, None] > thresholds).mean(0) for s in samples], axis=0)


def probability_of_improvement(samples: Sequence[Array], others: Sequence[Array]) -> float:
    """Return P(X > Y) + P(X = Y)/2 of a run X and another's Y, a mean over environments."""
    pairs = [np.sign(x[:, None] - y) for x, y in zip(samples, others, strict=True)]
    return float(np.mean([(1 + signs.mean()) / 2 for signs in pairs]))


def improvement(samples: Sequence[Array], others: Sequence[Array]) -> Estimate:
    """Return the probability of improvement; both sides are resampled."""
    n = len(samples)
    return stratified_bootstrap(
        [*samples, *others], lambda both: probability_of_improvement(both[:n], both[n:])
    )
