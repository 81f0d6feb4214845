"""Generalised advantages, and the cost advantages A_i that the estimators take."""

from __future__ import annotations

import math
import warnings

import numpy as np
from scipy.linalg import solve_banded

from sb3_crpn.arrays import FloatArray, IntArray
from sb3_crpn.episodes.batch import discount_factors, episode_scan, episode_starts, moments

# A rollout whose largest γ^t is smaller is warned of
NEGLIGIBLE = 1e-3


def generalized_advantages(
    rewards: FloatArray,
    values: FloatArray,
    terminal_values: FloatArray,
    lengths: IntArray,
    gamma: float,
    gae_lambda: float,
    clipped_ratios: FloatArray | None = None,
) -> FloatArray:
    """Return GAE(λ) advantages Σ_l (γλ)^l c_{i+1}⋯c_{i+l} δ_{i+l}, [T].

    δ_i = r_i + γ V(s_{i+1}) - V(s_i).

    Parameters
    ----------
    rewards, values
        r_i and V(s_i), [T].
    terminal_values
        V of the state after each segment's last step, [E]: 0 where the trajectory terminated.
    clipped_ratios
        c_i = min(1, π(a_i|s_i)/μ(a_i|s_i)), [T], μ the behaviour policy, as in Retrace and V-trace;
        ``None``: 1.

    References
    ----------
    Schulman et al., High-dimensional continuous control using generalized advantage estimation,
    ICLR 2016, eq. 16; Espeholt et al., IMPALA, ICML 2018, eq. 1.
    """
    last = episode_starts(lengths) + lengths - 1
    next_values = np.append(values[1:], 0.0)
    next_values[last] = terminal_values
    if clipped_ratios is None:
        # the λ-returns, then V: at λ = 1 nothing of V is left in the former, not even its rounding
        sources = rewards + gamma * (1.0 - gae_lambda) * next_values
        sources[last] += gamma * gae_lambda * terminal_values
        return episode_scan(sources, gamma * gae_lambda, lengths, reverse=True) - values
    delta = rewards + gamma * next_values - values
    if not len(delta):
        return delta
    # y_i - γλ c_{i+1} y_{i+1} = δ_i within each episode: one bidiagonal system
    bands = np.ones((2, len(delta)))
    bands[0, 1:] = -gamma * gae_lambda * clipped_ratios[1:]
    bands[0, episode_starts(lengths)] = 0.0
    advantages: FloatArray = solve_banded((0, 1), bands, delta, check_finite=False)
    return advantages


def cost_advantages(
    advantages: FloatArray,
    lengths: IntArray,
    times: IntArray,
    *,
    gamma: float,
    normalize_advantage: bool,
    discount_visitation: bool,
) -> FloatArray:
    """Return A_i = -γ^i Â_i, i the time in the trajectory, [T].

    ``times``, [E], is that of each segment's first step. Â is normalised to mean 0 and standard
    deviation 1 over the batch of all ranks on request; without ``discount_visitation`` the factor
    γ^i is dropped. A warning says where γ^i is negligible throughout: on endless tasks.
    """
    if normalize_advantage:
        mean, variance = moments(advantages)
        advantages = (advantages - mean) / (math.sqrt(variance) + 1e-8)  # 1e-8: as in SB3's PPO
    if discount_visitation:
        factors = discount_factors(gamma, lengths, times)
        if len(factors) and factors.max() < NEGLIGIBLE:
            warnings.warn(
                f"every timestep of the rollout weighs less than {NEGLIGIBLE}: with "
                "discount_visitation=True the weight is γ^t, t timesteps after the environment's "
                "reset. Pass discount_visitation=False, or an environment with a time limit",
                stacklevel=2,
            )
        advantages = advantages * factors
    return -advantages
