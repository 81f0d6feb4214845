r"""Default thresholds ε and ρ in the units of the task, and the number of episodes that decide.

The thresholds follow from two scales. G is the root mean square of the episodes' discounted
returns. Λ is the largest eigenvalue of the Fisher matrix of the distribution of episodes. A step of
length s = 1/√Λ changes this distribution by a KL divergence of at most ½, to second order. R = G/10
is the relevant difference of return. The defaults are

.. math:: \varepsilon = R / s, \qquad \sqrt{\rho\varepsilon} = 2R/s^2, \qquad
          \rho = 4\varepsilon / s^2.

At an ε-second-order stationary point the gradient lowers the cost over such a step by at most
εs = R, and the negative curvature by at most ½√(ρε)s² = R.

**Validity.** The intervals of ‖∇J‖ and λ_min(∇²J) do not depend on ε and ρ. If both cover the
truth, no verdict is wrong, for any thresholds. The confidence of a verdict is therefore that of the
intervals, also for thresholds from the same episodes or chosen after a look at the intervals. G and
Λ are means over episodes, so that the default thresholds converge with the number of episodes. A
comparison of several policies requires that ε and ρ be given.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import Tensor

from sb3_crpn.episodes import EpisodeBatch
from sb3_crpn.episodes.batch import episode_starts
from sb3_crpn.parameters import ActorParameters
from sb3_crpn.sosp.inference import Interval
from sb3_crpn.sosp.model_covariance import episode_fisher
from sb3_crpn.sosp.spectrum import largest_eigenvalue

# R/G. The number of episodes that decide is proportional to its inverse square
RELEVANT_FRACTION = 0.1


@dataclass(frozen=True)
class TaskScales:
    """The scales of a task and a policy.

    Attributes
    ----------
    rms_return
        G ≥ 0, the root mean square of the discounted returns.
    fisher_norm
        Λ ≥ 0, the largest eigenvalue of the Fisher matrix of the distribution of episodes.
    """

    rms_return: float
    fisher_norm: float

    @classmethod
    def from_episodes(
        cls, policy: ActorCriticPolicy, actor: ActorParameters, batch: EpisodeBatch
    ) -> TaskScales:
        """Estimate G and Λ. ``batch.returns`` are discounted, without bootstrap."""
        returns = batch.returns[episode_starts(batch.lengths)]
        fisher = episode_fisher(policy, actor, batch)
        like = torch.zeros(len(actor), dtype=torch.float64, device=actor.device)
        # a separate generator, so that the intervals do not depend on whether ε is given
        start = torch.Generator().manual_seed(0)
        return cls(float(np.sqrt((returns**2).mean())), largest_eigenvalue(fisher, like, start))

    @property
    def step_norm(self) -> float:
        """The length s = 1/√Λ of a step that changes the distribution of episodes by KL ≤ ½."""
        return 1.0 / math.sqrt(self.fisher_norm) if self.fisher_norm > 0.0 else math.inf


@dataclass(frozen=True)
class Thresholds:
    """ε ≥ 0, ρ ≥ 0 and their origin as text."""

    epsilon: float
    rho: float
    origin: str


def choose_thresholds(
    epsilon: float | None,
    rho: float | None,
    alpha: float | None,
    scales: Callable[[], TaskScales],
) -> Thresholds:
    """Return ε and ρ, with defaults for ``None``.

    Parameters
    ----------
    epsilon, rho
        As in :func:`certify_sosp`.
    alpha
        α of a model with the paper's cubic term, the default of ρ; ``None`` for other models.
    scales
        Returns the scales. Called only if a default needs them.
    """
    if rho is None and alpha is not None:
        rho, rho_origin = alpha, "ρ = α of the model"
    else:
        rho_origin = "ρ given" if rho is not None else "ρ = 4ε/s²"
    if epsilon is not None and rho is not None:
        return Thresholds(epsilon, rho, f"ε given, {rho_origin}")
    task = scales()
    parts = ["ε given", rho_origin, f"s = {task.step_norm:.3g} (episodes differ by KL ½)"]
    if epsilon is None:
        epsilon = RELEVANT_FRACTION * task.rms_return * math.sqrt(task.fisher_norm)
        parts[0] = f"ε = {RELEVANT_FRACTION:g} G/s"
        parts.append(f"G = {task.rms_return:.3g} (size of returns)")
    if rho is None:
        rho = 4.0 * epsilon * task.fisher_norm
    return Thresholds(epsilon, rho, ", ".join(parts))


def episodes_to_decide(
    of_gradient: Interval,
    of_curvature: Interval,
    gradient_norm: float,
    epsilon: float,
    curvature: float,
    n_episodes: int,
) -> int | None:
    """Return the approximate number of episodes that would decide, to two digits.

    The limits are supposed to approach the truth as 1/√n. The truth is supposed to be
    ``gradient_norm`` and the middle of λ_min's interval. ``None`` if an interval is unbounded, or
    if a supposed truth equals its threshold.

    Parameters
    ----------
    of_gradient, of_curvature
        The intervals of ‖∇J‖ and λ_min(∇²J) from ``n_episodes``.
    gradient_norm
        Estimate of ‖∇J‖ without the bias of noise: :func:`debiased_norm`.
    epsilon, curvature
        ε and -√(ρε).
    n_episodes
        Number of episodes of the intervals.
    """
    ratio = _width_ratio(of_gradient, gradient_norm, epsilon)
    if gradient_norm <= epsilon:  # at a stationary point the curvature has to be decided too
        middle = 0.5 * (of_curvature.lower + of_curvature.upper)
        ratio = max(ratio, _width_ratio(of_curvature, middle, curvature))
    needed = n_episodes * ratio**2
    if not math.isfinite(needed):
        return None
    unit = 10.0 ** max(0, math.floor(math.log10(max(needed, 1.0))) - 1)
    return int(unit * math.ceil(needed / unit))


def debiased_norm(gradients: Tensor) -> float:
    """Return an estimate of ‖∇J‖ without the bias of noise, from independent g_k, [K, d].

    ‖ĝ‖² minus the trace of ĝ's sample covariance is an unbiased estimate of ‖∇J‖². The result is
    the square root of its positive part.
    """
    mean = gradients.mean(0)
    variance = ((gradients - mean) ** 2).sum() / (len(gradients) * (len(gradients) - 1))
    return math.sqrt(max(0.0, float((mean**2).sum() - variance)))


def _width_ratio(interval: Interval, truth: float, threshold: float) -> float:
    """Return the interval's width around ``truth`` relative to the distance of the threshold."""
    width = max(truth - interval.lower, interval.upper - truth)
    distance = abs(truth - threshold)
    return width / distance if distance > 0.0 and math.isfinite(width) else math.inf
