r"""The thresholds ε and ρ in the task's own units, and how many episodes would decide.

Two scales of the task and the policy make the thresholds: G, the root mean square of the episodes'
discounted returns, and Λ, the largest eigenvalue of the Fisher matrix of a whole episode. A step of
length s = 1/√Λ changes the distribution of episodes by a KL divergence of at most ½, to second
order. With R = G/10, a difference of return that matters,

.. math:: \varepsilon = R / s, \qquad \sqrt{\rho\varepsilon} = 2R/s^2, \qquad
          \rho = 4\varepsilon / s^2:

of an ε-second-order stationary point neither the slope, at most εs, nor the curvature, at most
½√(ρε)s², lowers the cost by more than R over such a step.

**Validity.** The intervals of ‖∇J‖ and λ_min(∇²J) do not depend on ε and ρ, and where both cover
the truth no verdict is wrong, whatever the thresholds. A verdict is thus as certain as the
intervals are, for all thresholds at once: those of the same episodes, too, and those chosen after
the intervals were seen. What the data choose is the question, not the certainty of the answer. It
converges as episodes grow, since G and Λ are means over them; where several policies are to answer
one question, ε and ρ are to be given.
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
from sb3_crpn.sosp.spectrum import lanczos_spectrum

# R/G. The smaller, the more episodes decide: their number goes with its square
RELEVANT = 0.1

# Lanczos steps for Λ, as for the largest noise (inference.py)
_FISHER_STEPS = 6


@dataclass(frozen=True)
class TaskScales:
    """G ≥ 0, root mean square of the discounted returns, and Λ ≥ 0 of the episodes' Fisher."""

    returns: float
    fisher: float

    @classmethod
    def from_episodes(
        cls, policy: ActorCriticPolicy, actor: ActorParameters, batch: EpisodeBatch
    ) -> TaskScales:
        """Measure both; ``batch.returns`` are discounted, without bootstrap."""
        returns = batch.returns[episode_starts(batch.lengths)]
        fisher = episode_fisher(policy, actor, batch)
        like = torch.zeros(len(actor), dtype=torch.float64, device=actor.device)
        # a generator of its own: the intervals are not to depend on whether ε is given
        start = torch.Generator().manual_seed(0)
        negative = lanczos_spectrum(lambda v: -fisher(v), like, start, n_steps=_FISHER_STEPS)
        return cls(float(np.sqrt((returns**2).mean())), max(0.0, -float(negative.leftmost[0])))

    @property
    def distance(self) -> float:
        """s, the length of a step that changes episodes by a KL divergence of ½."""
        return 1.0 / math.sqrt(self.fisher) if self.fisher > 0.0 else math.inf


@dataclass(frozen=True)
class Thresholds:
    """ε ≥ 0 and ρ ≥ 0, and where they come from, for people."""

    epsilon: float
    rho: float
    origin: str


def choose_thresholds(
    epsilon: float | None,
    rho: float | None,
    alpha: float | None,
    scales: Callable[[], TaskScales],
) -> Thresholds:
    """Return the given ε and ρ, and the defaults where they are ``None``.

    Parameters
    ----------
    epsilon, rho
        As in :func:`certify_sosp`.
    alpha
        α of a model with the paper's cubic term, which is ρ by default; ``None`` for others.
    scales
        Measures the task; called only where a default needs it.
    """
    if rho is None and alpha is not None:
        rho, rho_origin = alpha, "ρ = α of the model"
    else:
        rho_origin = "ρ given" if rho is not None else "ρ = 4ε/s²"
    if epsilon is not None and rho is not None:
        return Thresholds(epsilon, rho, f"ε given, {rho_origin}")
    task = scales()
    parts = ["ε given", rho_origin, f"s = {task.distance:.3g} (episodes differ by KL ½)"]
    if epsilon is None:
        epsilon = RELEVANT * task.returns * math.sqrt(task.fisher)
        parts[0] = f"ε = {RELEVANT:g} G/s"
        parts.append(f"G = {task.returns:.3g} (size of returns)")
    if rho is None:
        rho = 4.0 * epsilon * task.fisher
    return Thresholds(epsilon, rho, ", ".join(parts))


def episodes_to_decide(
    of_gradient: Interval,
    of_curvature: Interval,
    gradient_norm: float,
    epsilon: float,
    curvature: float,
    n_episodes: int,
) -> int | None:
    """Return about how many episodes would decide, to two digits; ``None`` if that is unknown.

    The limits approach what is likely as 1/√n: ‖∇J‖ without the bias of noise, and the middle of
    λ_min's interval. Unknown where an interval is unlimited, or what is likely is the threshold.

    Parameters
    ----------
    of_gradient, of_curvature
        The intervals from ``n_episodes``.
    gradient_norm
        What ‖∇J‖ likely is.
    epsilon, curvature
        ε and -√(ρε).
    """
    times = _times_narrower(of_gradient, gradient_norm, epsilon)
    if gradient_norm <= epsilon:  # stationarity is likely: curvature decides
        middle = 0.5 * (of_curvature.lower + of_curvature.upper)
        times = max(times, _times_narrower(of_curvature, middle, curvature))
    needed = n_episodes * times**2
    if not math.isfinite(needed):
        return None
    unit = 10.0 ** max(0, math.floor(math.log10(max(needed, 1.0))) - 1)
    return int(unit * math.ceil(needed / unit))


def likely_norm(gradients: Tensor) -> float:
    """Return ‖∇J‖ as estimated without the bias of noise, from independent g_k, [K, d].

    ‖ĝ‖² less the noise of ĝ is an unbiased estimate of ‖∇J‖²; where it is negative, 0.
    """
    mean = gradients.mean(0)
    noise = ((gradients - mean) ** 2).sum() / (len(gradients) * (len(gradients) - 1))
    return math.sqrt(max(0.0, float((mean**2).sum() - noise)))


def _times_narrower(interval: Interval, likely: float, threshold: float) -> float:
    """Return how many times as narrow the interval around ``likely`` excludes the threshold."""
    width = max(likely - interval.lower, interval.upper - likely)
    distance = abs(likely - threshold)
    return width / distance if distance > 0.0 and math.isfinite(width) else math.inf
