r"""Parameters with which CRPN and ACRPN provably reach an ε-second-order stationary point.

An ε-SOSP has ‖∇J‖ ≤ ε and λ_min(∇²J) ≥ -√(ρε), ρ = L_H. The orders in ε are the paper's:
ε^{-3/2} updates of m = O(ε^{-2}) and b = O(ε^{-1}) episodes, ε^{-3.5} in all. The constants are
derived here.

**One update.** Let s, ‖s‖ = r, be a global minimiser of the cubic model, θ⁺ = θ + s, L = L_H,
e_1 = ‖g - ∇J(θ)‖ and e_2 = ‖H - ∇²J(θ)‖. Then m(s) ≤ -(α/12)r³, g + Hs + (α/2)rs = 0 and
H + (α/2)rI ⪰ 0, whence by Taylor's formula

(1) J(θ) - J(θ⁺) ≥ ((3α - 2L)/12) r³ - e_1 r - ½e_2 r²,
(2) ‖∇J(θ⁺)‖ ≤ ((α + L)/2) r² + e_1 + e_2 r,
(3) -λ_min(∇²J(θ⁺)) ≤ (α/2 + L) r + e_2.

In the units √(ε/L) of length, ε^{3/2}/√L of J, and with e_1 = c_1 ε, e_2 = c_2√(Lε) and α = 3L, a
step of length x gains at least h(x) = (7/12)x³ - c_1 x - ½c_2 x². For c_1 = 3/64, c_2 = 1/16 and
t = 3/8, h(x) ≥ h(t) = 9/1024 where x ≥ t, while x ≤ t makes (2) at most 0.36 ε and (3) at most
√(Lε). So either the step is longer than t and gains 9/1024, which can happen no more than
(1024/9) (J(θ_0) - J*) √L / ε^{3/2} times, or θ⁺ is an ε-SOSP.

**In practice** these numbers of episodes are out of reach for all but the smallest problems: the
bounds hold for the worst policy, reward and dynamics that K, G, L_1, L_2 and H allow.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from sb3_crpn.checks import COUNT, POSITIVE, real, requires
from sb3_crpn.theory.constants import Constants


class _Plan(NamedTuple):
    """c_1 and c_2, the errors that a step may suffer, and what it then gains; see above."""

    gradient_error: float
    hessian_error: float
    gain: float


# (5/2)t + c_2 = 1 makes (3) hold, and c_1 = 2A/(3t), A = (7/12)t³ - ½c_2t², makes N·m least
_EXACT = _Plan(3 / 64, 1 / 16, 9 / 1024)
_LONGEST_SOSP_STEP = 3 / 8
_APPROXIMATE = _Plan(1 / 150, 1 / 200, 1 / 320)
# The least ℓ/√(ρε): a smaller one would make the perturbation too large
_LEAST_CONDITION = 150.0
# The descent's step is 1/(20ℓ) (Tripuraneni et al., NeurIPS 2018)
_STEP_DIVISOR = 20.0
# κ, the negative curvature, as a part of √(ρε), that the descent must make out
_VISIBLE_CURVATURE = 0.25

CONSTANTS = requires("a Constants", lambda value: isinstance(value, Constants))
PROBABILITY = real(0.0, 1.0, open_low=True, open_high=True)


@dataclass(frozen=True)
class Recipe:
    """Parameters of a convergence theorem.

    Attributes
    ----------
    kwargs
        Keyword arguments, to be used as ``CRPN("MlpPolicy", env, **{**PAPER, **recipe.kwargs})``.
    n_updates
        N, the number of updates.
    epsilon, rho
        ε, in the units of ∇J, and ρ = L_H, in those of ∇³J.
    sosp_step_norm
        A step no longer than this leads to an ε-SOSP (with the high-probability recipe's
        probability); ``None`` where the theorem does not say which of the iterates is one.
    gradient_factor, curvature_factor
        The guarantee in units of ε and √(ρε): 1 and 1 of an ε-SOSP; as printed, 25 and 7.
    """

    kwargs: Mapping[str, Any]
    n_updates: int
    epsilon: float
    rho: float
    sosp_step_norm: float | None = None
    gradient_factor: float = 1.0
    curvature_factor: float = 1.0

    @property
    def gradient_bound(self) -> float:
        """The bound on ‖∇J‖ that is guaranteed."""
        return self.gradient_factor * self.epsilon

    @property
    def curvature_bound(self) -> float:
        """The bound on -λ_min(∇²J) that is guaranteed."""
        return self.curvature_factor * math.sqrt(self.rho * self.epsilon)

    @property
    def gradient_episodes(self) -> int:
        """Σ_k m_k."""
        return int(self.n_updates * self.kwargs["n_episodes"])

    @property
    def hessian_episodes(self) -> int:
        """Σ_k b_k."""
        return int(self.n_updates * self.kwargs["n_hessian_episodes"])

    @property
    def episodes_per_update(self) -> int:
        """max(m_k, b_k); the paper's min, a slip, would not leave enough for the larger of them."""
        return int(max(self.kwargs["n_episodes"], self.kwargs["n_hessian_episodes"]))

    def total_timesteps(self, n_envs: int = 1) -> int:
        """Return timesteps that suffice ``learn`` for N updates over ``n_envs`` environments.

        All episodes are taken to last H steps; shorter ones make more updates, which does no harm.
        """
        n_envs = COUNT("total_timesteps: n_envs", n_envs)
        rounds = -(-self.episodes_per_update // n_envs)
        return int(self.n_updates * rounds * n_envs * self.kwargs["horizon"])


def expectation_recipe(
    constants: Constants, epsilon: float, initial_gap: float | None = None
) -> Recipe:
    """Return CRPN's parameters for E‖∇J(θ_R)‖ ≤ ε and E[λ_min(∇²J(θ_R))] ≥ -√(L_H ε).

    R is drawn from P(R = k) ∝ α_k, k = 1, …, N, uniformly as α is constant, θ_k being the iterate
    *after* update k: :class:`~sb3_crpn.callbacks.RandomIterateCallback`.

    With X³ = E r_R³ and Hölder's inequality, the mean of (1) over k = 1, …, N is h(X) ≤
    (J(θ_0) - J*)√L/(N ε^{3/2}) ≤ h(t) with c_1 ε ≥ (E e_1^{3/2})^⅔ and c_2√(Lε) ≥ (E e_2³)^⅓, hence
    X ≤ t, and (2) and (3) hold in the mean by Jensen's. The second and third moments are those of
    :meth:`Constants.gradient_error` and :meth:`Constants.hessian_error`.

    Parameters
    ----------
    constants
        Of the policy and the environment.
    epsilon
        ε in (0, M_H²/L_H]: beyond, √(L_H ε) ≥ M_H and the second-order condition says nothing.
    initial_gap
        J(θ_0) - J* or a bound on it; ``None``: 2K S_0, which always holds.

    Raises
    ------
    ValueError
        ``epsilon`` or ``initial_gap`` is out of range.
    """
    epsilon, n_updates = _checked("expectation_recipe", constants, epsilon, initial_gap, _EXACT)
    gradient_error, hessian_error = _allowed_errors(constants, epsilon, _EXACT)
    m = math.ceil((constants.gradient_error(1) / gradient_error) ** 2)
    b = math.ceil((constants.hessian_error(1) / hessian_error) ** 2)
    kwargs = {**batches(constants, m, b), "alpha": 3.0 * constants.L_H}
    return Recipe(kwargs, n_updates, epsilon, constants.L_H)


def high_probability_recipe(
    constants: Constants,
    epsilon: float,
    failure_probability: float,
    initial_gap: float | None = None,
) -> Recipe:
    """Return CRPN's parameters that make one of θ_1, …, θ_N an ε-SOSP with high probability.

    The first step with ‖s_k‖ ≤ ``sosp_step_norm`` = (3/8)√(ε/L_H) tells which: θ_k, the iterate
    after it. Step lengths are logged as ``train/step_norm``.

    Bernstein's inequality (Tropp, Found. Comput. Math. 12, 2012, Theorem 1.6) makes all 2N errors
    small enough: e ≤ u but for probability δ' = δ/(2N) with
    ``n ≥ (8/3) log(2d/δ') max(M/u, σ²/u²)`` episodes, (M, σ) = (M_1, G_g) and (M_2, G_H).

    Parameters
    ----------
    constants, epsilon, initial_gap
        As in :func:`expectation_recipe`.
    failure_probability
        δ in (0, 1).

    Raises
    ------
    ValueError
        An argument is out of range.
    """
    epsilon, n_updates = _checked(
        "high_probability_recipe", constants, epsilon, initial_gap, _EXACT
    )
    failure_probability = PROBABILITY(
        "high_probability_recipe: failure_probability", failure_probability
    )
    m, b = _bernstein(constants, epsilon, failure_probability, n_updates, _EXACT)
    kwargs = {**batches(constants, m, b), "alpha": 3.0 * constants.L_H}
    longest = _LONGEST_SOSP_STEP * math.sqrt(epsilon / constants.L_H)
    return Recipe(kwargs, n_updates, epsilon, constants.L_H, longest)


def approximate_recipe(
    constants: Constants,
    epsilon: float,
    failure_probability: float,
    initial_gap: float | None = None,
) -> Recipe:
    """Return ACRPN's parameters; it then ends by itself, within N updates, at an ε-SOSP.

    α = ρ = L_H. Let Δ* be a global minimiser of the model and Δ the subsolver's step, in the units
    of this module's docstring. Gradient descent from 0 grows no longer than its minimiser (Carmon
    and Duchi, SIAM J. Optim. 29, 2019), and the perturbation σ = ε√(ρε)/ℓ lengthens that by
    √(2σ/ρ) at most, which is 0.12 for ℓ = 150√(ρε), the least ℓ used here. *Supposed* is that N̂
    steps attain nine tenths of the decrease that the perturbed model allows; the tests measure it.
    Then

    - while -m(Δ) > 1/100, also -m(Δ) ≥ 0.43·(-m(Δ*)) ≥ 0.43·‖Δ*‖³/12, and with c_1 = 1/150 and
      c_2 = 1/200 an update gains 1/320: N = 320 (J(θ_0) - J*) √ρ / ε^{3/2};
    - once -m(Δ) ≤ 1/100, ‖Δ*‖ ≤ 0.65, and the final solver's step, where ‖∇m‖ ≤ ε/2, leads to
      ‖∇J‖ ≤ (½ + 0.65² + c_1 + 0.65c_2) ε < ε and -λ_min ≤ (1.5·0.65 + c_2)√(ρε) < √(ρε).

    A Cauchy step is taken only where ‖g‖ ≥ ℓ²/ρ, and gains far more: -m(Δ) ≥ ⅓√(‖g‖³/ρ).

    Where the paper differs: its σ = c'√(ερ)/ℓ is no gradient, ε√(ρε)/ℓ has its units; and its
    N̂ = 1/√ε lacks ℓ/√ρ and a logarithm. A direction of curvature -κ√(ρε) grows by
    1 + κ√(ρε)/(20ℓ) a step, from σ/(20ℓ√d) to √(ε/ρ), whence
    N̂ = (20/κ)(ℓ/√(ρε)) log(1 + 20√d ℓ²/(ρε)). κ = ¼, since a decrease of 1/100 must
    not be missed, which a curvature of -0.25√(ρε) alone allows.

    Parameters
    ----------
    constants, epsilon, initial_gap
        As in :func:`expectation_recipe`.
    failure_probability
        δ in (0, 1), of the estimates.

    Raises
    ------
    ValueError
        An argument is out of range.
    """
    epsilon, n_updates = _checked(
        "approximate_recipe", constants, epsilon, initial_gap, _APPROXIMATE
    )
    failure_probability = PROBABILITY(
        "approximate_recipe: failure_probability", failure_probability
    )
    m, b = _bernstein(constants, epsilon, failure_probability, n_updates, _APPROXIMATE)
    curvature = math.sqrt(constants.L_H * epsilon)
    # ℓ ≥ ‖H‖: at most M_H + c_2√(ρε)
    largest = constants.M_H / curvature + _APPROXIMATE.hessian_error
    condition = max(largest, _LEAST_CONDITION)
    growth = math.log1p(_STEP_DIVISOR * math.sqrt(constants.d) * condition**2)
    kwargs = {
        **batches(constants, m, b),
        "alpha": constants.L_H,
        "sosp_epsilon": epsilon,
        "gradient_lipschitz": condition * curvature,
        "subsolver_steps": math.ceil(_STEP_DIVISOR / _VISIBLE_CURVATURE * condition * growth),
        "stop_at_sosp": True,
    }
    return Recipe(kwargs, n_updates, epsilon, constants.L_H)


def batches(constants: Constants, m: int, b: int) -> dict[str, Any]:
    """Return m, b and what the constants suppose of an episode, as keyword arguments."""
    return {
        "n_episodes": m,
        "n_hessian_episodes": b,
        "gamma": constants.gamma,
        "horizon": constants.H,
    }


def _checked(
    function: str, constants: Constants, epsilon: float, initial_gap: float | None, plan: _Plan
) -> tuple[float, int]:
    """Return ε and the least N whose gains exceed J(θ_0) - J*, for good arguments."""
    constants = CONSTANTS(f"{function}: constants", constants)
    largest = constants.M_H**2 / constants.L_H
    epsilon = real(0.0, largest, open_low=True)(f"{function}: epsilon", epsilon)
    if initial_gap is None:
        initial_gap = 2.0 * constants.cost_bound
    initial_gap = POSITIVE(f"{function}: initial_gap", initial_gap)
    gain = plan.gain * epsilon * math.sqrt(epsilon / constants.L_H)
    return epsilon, math.floor(initial_gap / gain) + 1


def _allowed_errors(constants: Constants, epsilon: float, plan: _Plan) -> tuple[float, float]:
    """Return c_1 ε and c_2 √(L_H ε)."""
    return plan.gradient_error * epsilon, plan.hessian_error * math.sqrt(constants.L_H * epsilon)


def _bernstein(
    constants: Constants, epsilon: float, failure_probability: float, n_updates: int, plan: _Plan
) -> tuple[int, int]:
    """Return m and b that keep the errors small enough in all updates; see the caller."""
    logarithm = math.log(4.0 * constants.d * n_updates / failure_probability)

    def batch(largest: float, deviation: float, error: float) -> int:
        return math.ceil(8 / 3 * logarithm * max(largest / error, (deviation / error) ** 2))

    gradient_error, hessian_error = _allowed_errors(constants, epsilon, plan)
    return (
        batch(constants.M_1, constants.G_g, gradient_error),
        batch(constants.M_2, constants.G_H, hessian_error),
    )
