"""Fitting the step's length to a target KL divergence, and scaling the target."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

# target_kl counts as met within 10 per cent (DESIGN section 5)
KL_TOLERANCE = 0.1
# Bisection on log α: 40 trials narrow 30 decades to the tolerance
MAX_TRIALS = 40
# Below it the cubic term is lost in the rounding of the others; far below it, α is 0
LOG_MIN_ALPHA = math.log(1e-30)

# Steps are shortened where the returns' standard deviation is below this fraction of its recent
# maximum, which fades by the factor SCALE_DECAY an update
FULL_KL_FRACTION = 0.2
SCALE_DECAY = 0.99
# The shortest, a hundredth: its KL divergence can still be told from 0 in single precision
MIN_KL_SCALE = 1e-2


@dataclass
class KLControl:
    """What a run remembers to choose α and the target of the next update.

    Attributes
    ----------
    alpha
        The last α that met a target; ``None`` before the first.
    return_scale
        σ̄_k, the largest standard deviation of the returns so far, fading.
    """

    alpha: float | None = None
    return_scale: float = 0.0

    def scaled_target(self, target_kl: float, deviation: float) -> float:
        """Return δ_k = δ min(1, 5σ_k/σ̄_k)², σ̄_k = max(σ_k, 0.99 σ̄_{k-1}), δ = ``target_kl``.

        Once a task is solved all episodes are alike and σ_k falls by orders of magnitude: what is
        left to the advantages is the critic's error, which a step that is fitted to a target
        follows as far as it followed the returns. This one's length is in proportion to σ_k.

        Parameters
        ----------
        target_kl
            δ.
        deviation
            σ_k, the standard deviation of the λ-returns, in the environment's own rewards. One
            that is not finite changes nothing: nor is the step, which is rejected.
        """
        if not math.isfinite(deviation):
            return target_kl
        self.return_scale = max(deviation, SCALE_DECAY * self.return_scale)
        full = FULL_KL_FRACTION * self.return_scale
        kl_scale = deviation / full if full else 1.0
        return target_kl * min(1.0, max(MIN_KL_SCALE, kl_scale)) ** 2

    def first_alpha(self, scheduled: float) -> float:
        """Return where the search for α begins: the last α, or before the first the schedule's."""
        return scheduled if self.alpha is None else self.alpha


class Trial(Protocol):
    """A step that was tried."""

    @property
    def kl(self) -> float:
        """Its mean KL divergence."""
        ...


T = TypeVar("T", bound=Trial)


def fit_alpha(attempt: Callable[[float], T], alpha: float, target: float) -> T:
    """Return the trial of the smallest α that keeps the mean KL ≤ ``target``, within 10 per cent.

    The KL falls with α, as 1/α where the cubic term dominates: the first guesses extrapolate that
    law on log α, bisection takes over once the target is bracketed. Where a smaller α no longer
    raises the KL (the Newton step lies inside the trust region), or the target is jumped over, the
    best trial is returned; where no trial keeps the target, the last. No α is tried twice.

    Parameters
    ----------
    attempt
        α ↦ trial of its step; a KL that is not a number or infinite counts as too large.
    alpha
        Where to start, > 0.
    target
        > 0.
    """
    low, high = -math.inf, math.inf  # log α with too large a KL, and with an allowed one
    best: T | None = None  # the trial at ``high``
    log_alpha = math.log(alpha)
    for _ in range(MAX_TRIALS):
        trial = attempt(math.exp(log_alpha))
        if math.isfinite(trial.kl) and trial.kl <= target:
            if trial.kl >= (1.0 - KL_TOLERANCE) * target:
                return trial
            if best is not None and low == -math.inf and trial.kl <= best.kl * 1.01:
                return best
            high, best = log_alpha, trial
        else:
            low = log_alpha
        log_alpha = _next_log_alpha(log_alpha, trial.kl, target, low, high)
        if high - low < 1e-6 or log_alpha in (low, high):
            break
    return trial if best is None else best


def _next_log_alpha(
    log_alpha: float, divergence: float, target: float, low: float, high: float
) -> float:
    if math.isfinite(low) and math.isfinite(high):
        return 0.5 * (low + high)
    return max(LOG_MIN_ALPHA, log_alpha + _extrapolate(divergence, target))


def _extrapolate(divergence: float, target: float) -> float:
    """Return the change of log α that brings KL ∝ 1/α to the middle of the tolerance."""
    if not math.isfinite(divergence):
        return math.log(100.0)
    middle = (1.0 - 0.5 * KL_TOLERANCE) * target
    change = math.log(max(divergence, 1e-12 * target) / middle)
    # twice the law's step where it is small, so that a flatter law is bracketed soon
    return math.copysign(max(2.0 * abs(change) if abs(change) < 1.0 else abs(change), 0.1), change)
