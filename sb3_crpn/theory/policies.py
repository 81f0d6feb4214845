"""Bounds G, L_1 and L_2 on the derivatives of log π, for policies linear in bounded features."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sb3_crpn.checks import COUNT, FLAG, POSITIVE, real


@dataclass(frozen=True)
class ScoreBounds:
    """Bounds on the derivatives of log π(a|s;θ) with respect to θ, for all s, a and θ.

    Norms are Euclidean and spectral. With the unit u of θ, the units are 1/u, 1/u² and 1/u³.

    Attributes
    ----------
    G
        ‖∇log π‖ ≤ G.
    L_1
        ‖∇²log π‖ ≤ L_1.
    L_2
        ‖∇²log π(a|s;θ) - ∇²log π(a|s;θ')‖ ≤ L_2 ‖θ - θ'‖.
    """

    G: float
    L_1: float
    L_2: float

    def __post_init__(self) -> None:
        for name, check in (("G", POSITIVE), ("L_1", real(0.0)), ("L_2", real(0.0))):
            value = check(f"ScoreBounds: {name}", getattr(self, name))
            object.__setattr__(self, name, value)


def softmax_linear(feature_norm: float, *, bias: bool = True) -> ScoreBounds:
    """Return the bounds of π(·|s) = softmax(Wφ(s) + b), ‖φ(s)‖ ≤ ``feature_norm``.

    This is SB3's policy on a Discrete action space with ``net_arch=[]``. φ is the observation. The
    one-hot vector of a Discrete observation has norm 1.

    Let B² = ‖φ‖² (+ 1 for b). The derivatives of log π are those of log-sum-exp: the cumulants of
    the one-hot action e_a under π times powers of φ.

    - ∇log π = (e_a - π) ⊗ φ, and ‖e_a - π‖ < √2. Hence G = √2·B, the supremum as π_a → 0.
    - -∇²log π = Cov(e_a) ⊗ φφᵀ. For a unit vector u, u_a has range ≤ √2, and its variance is at
      most √2²/4. Hence L_1 = B²/2, attained by two equally probable actions.
    - -∇³log π [v, v, v] is the third central moment of (Vφ)_a, at most range³/(6√3). Hence
      L_2 = (√6/9)·B³, attained by two actions of probabilities (1 ± 1/√3)/2.

    Parameters
    ----------
    feature_norm
        Bound on ‖φ(s)‖, > 0.
    bias
        Whether b is a parameter, as in SB3.
    """
    norm = _norm("softmax_linear", feature_norm, bias)
    return ScoreBounds(
        G=math.sqrt(2.0) * norm, L_1=norm**2 / 2.0, L_2=math.sqrt(6.0) / 9.0 * norm**3
    )


def gaussian_linear(
    feature_norm: float,
    std: float,
    action_dim: int,
    *,
    n_actions: int,
    failure_probability: float,
    bias: bool = True,
) -> ScoreBounds:
    """Return the bounds of π(·|s) = N(Wφ(s) + b, Σ) with fixed, diagonal Σ.

    **G does not bound every score.** The score Σ⁻¹(a - μ) ⊗ φ of a Gaussian policy is unbounded. G
    bounds the scores of the first ``n_actions`` actions with probability at least
    1 - ``failure_probability``. SB3 clips actions for the environment only. log π is that of the
    unclipped action, so that the bounds hold with clipping.

    Let B² = ‖φ‖² (+ 1 for b), and let ξ = Σ^(-½)(a - μ), standard normal of dimension k.

    - ‖∇log π‖ ≤ (B/std)‖ξ‖. ‖ξ‖² > k + 2√(kx) + 2x has a probability of at most e^(-x) (Laurent and
      Massart, Ann. Statist. 28, 2000, Lemma 1). x = log(n_actions/failure_probability).
    - ∇²log π = -Σ⁻¹ ⊗ φφᵀ. Hence L_1 = B²/std² for every action.
    - ∇²log π does not depend on θ. Hence L_2 = 0.

    In SB3 log_std is a parameter by default. The bounds require a fixed log_std
    (``policy.log_std.requires_grad_(False)`` before the algorithm selects the actor).

    Parameters
    ----------
    feature_norm
        Bound on ‖φ(s)‖, > 0.
    std
        The smallest standard deviation, > 0.
    action_dim
        k, the dimension of the action.
    n_actions
        Number of actions of all updates and environments together.
    failure_probability
        In (0, 1].
    bias
        Whether b is a parameter, as in SB3.
    """
    norm = _norm("gaussian_linear", feature_norm, bias)
    std = POSITIVE("gaussian_linear: std", std)
    action_dim = COUNT("gaussian_linear: action_dim", action_dim)
    n_actions = COUNT("gaussian_linear: n_actions", n_actions)
    failure_probability = real(0.0, 1.0, open_low=True)(
        "gaussian_linear: failure_probability", failure_probability
    )
    x = math.log(n_actions / failure_probability)
    noise = math.sqrt(action_dim + 2.0 * math.sqrt(action_dim * x) + 2.0 * x)
    return ScoreBounds(G=noise * norm / std, L_1=(norm / std) ** 2, L_2=0.0)


def _norm(function: str, feature_norm: float, bias: bool) -> float:
    """Return the bound on the norm of the features, including the constant feature of a bias."""
    norm: float = POSITIVE(f"{function}: feature_norm", feature_norm)
    return math.hypot(norm, 1.0) if FLAG(f"{function}: bias", bias) else norm
