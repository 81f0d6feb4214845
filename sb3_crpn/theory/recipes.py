r"""Parameters with which CRPN and ACRPN provably reach an ε-second-order stationary point.

An ε-SOSP has ‖∇J‖ ≤ ε and λ_min(∇²J) ≥ -√(ρε), ρ = L_H. The orders in ε are the paper's: ε^{-3/2}
updates with m = O(ε^{-2}) and b = O(ε^{-1}) episodes, O(ε^{-3.5}) episodes together. The constants
are derived here.

**One update.** Let s be a global minimiser of the cubic model, r = ‖s‖, θ⁺ = θ + s, L = L_H,
e_1 = ‖g - ∇J(θ)‖ and e_2 = ‖H - ∇²J(θ)‖. Then m(s) ≤ -(α/12)r³, g + Hs + (α/2)rs = 0 and
H + (α/2)rI ⪰ 0. By Taylor's formula

(1) J(θ) - J(θ⁺) ≥ ((3α - 2L)/12) r³ - e_1 r - ½e_2 r²,
(2) ‖∇J(θ⁺)‖ ≤ ((α + L)/2) r² + e_1 + e_2 r,
(3) -λ_min(∇²J(θ⁺)) ≤ (α/2 + L) r + e_2.

Let the unit of length be √(ε/L), the unit of J ε^{3/2}/√L, e_1 = c_1 ε, e_2 = c_2√(Lε) and α = 3L.
A step of length x decreases J by at least h(x) = (7/12)x³ - c_1 x - ½c_2 x². Take c_1 = 3/64,
c_2 = 1/16 and t = 3/8. For x ≥ t, h(x) ≥ h(t) = 9/1024. For x ≤ t, (2) is at most 0.36 ε and (3) is
at most √(Lε). A step is therefore either longer than t and decreases J by 9/1024, or leads to an
ε-SOSP. At most (1024/9) (J(θ_0) - J*) √L / ε^{3/2} steps are longer than t.

**In practice** these numbers of episodes are affordable for the smallest problems only. The bounds
hold for the worst policy, reward and dynamics with the given K, G, L_1, L_2 and H.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from sb3_crpn.checks import COUNT, POSITIVE, real, requires
from sb3_crpn.theory.constants import Constants


class _Errors(NamedTuple):
    """c_1 and c_2, the allowed errors of g and H, and the decrease of J by a long step."""

    gradient: float
    hessian: float
    decrease: float


# (5/2)t + c_2 = 1 implies (3). c_1 = 2A/(3t), A = (7/12)t³ - ½c_2t², minimises N·m
_EXACT = _Errors(3 / 64, 1 / 16, 9 / 1024)
_MAX_SOSP_STEP = 3 / 8
_APPROXIMATE = _Errors(1 / 150, 1 / 200, 1 / 320)
# Minimum of ℓ/√(ρε), which bounds the perturbation σ
_MIN_CONDITION = 150.0
# The step size of the descent is 1/(20ℓ) (Tripuraneni et al., NeurIPS 2018)
_STEP_DIVISOR = 20.0
# κ: the descent has to escape along a curvature of -κ√(ρε)
_RESOLVED_CURVATURE = 0.25

CONSTANTS = requires("a Constants", lambda value: isinstance(value, Constants))
PROBABILITY = real(0.0, 1.0, open_low=True, open_high=True)


@dataclass(frozen=True)
class Recipe:
    """Parameters of a convergence theorem.

    Attributes
    ----------
    kwargs
        Keyword arguments, for ``CRPN("MlpPolicy", env, **{**PAPER, **recipe.kwargs})``.
    n_updates
        N, the number of updates.
    epsilon, rho
        ε, in the units of ∇J, and ρ = L_H, in those of ∇³J.
    sosp_step_norm
        A step of at most this length leads to an ε-SOSP, with the probability of the recipe.
        ``None`` if the theorem does not identify the iterate.
    gradient_factor, curvature_factor
        The guarantee in units of ε and √(ρε): 1 and 1 for an ε-SOSP, 25 and 7 for the printed
        recipes of CRPN.
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
        """The guaranteed bound on ‖∇J‖."""
        return self.gradient_factor * self.epsilon

    @property
    def curvature_bound(self) -> float:
        """The guaranteed bound on -λ_min(∇²J)."""
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
        """max(m_k, b_k). The paper's min is an erratum: it is below the larger of the two."""
        return int(max(self.kwargs["n_episodes"], self.kwargs["n_hessian_episodes"]))

    def total_timesteps(self, n_envs: int = 1) -> int:
        """Return timesteps with which ``learn`` makes N updates on ``n_envs`` environments.

        All episodes are supposed to have H steps. Shorter episodes give more than N updates.
        """
        n_envs = COUNT("total_timesteps: n_envs", n_envs)
        rounds = -(-self.episodes_per_update // n_envs)
        return int(self.n_updates * rounds * n_envs * self.kwargs["horizon"])


def expectation_recipe(
    constants: Constants, epsilon: float, initial_gap: float | None = None
) -> Recipe:
    """Return CRPN's parameters for E‖∇J(θ_R)‖ ≤ ε and E[λ_min(∇²J(θ_R))] ≥ -√(L_H ε).

    R has P(R = k) ∝ α_k, k = 1, …, N, which is uniform for constant α. θ_k is the iterate *after*
    update k: :class:`~sb3_crpn.callbacks.RandomIterateCallback`.

    Let X³ = E r_R³, c_1 ε ≥ (E e_1^{3/2})^⅔ and c_2√(Lε) ≥ (E e_2³)^⅓. By Hölder's inequality the
    mean of (1) over k is h(X) ≤ (J(θ_0) - J*)√L/(N ε^{3/2}) ≤ h(t). Hence X ≤ t. (2) and (3) then
    hold in expectation by Jensen's inequality. :meth:`Constants.gradient_error` and
    :meth:`Constants.hessian_error` bound the second and third moments of the errors.

    Parameters
    ----------
    constants
        Constants of the policy and the environment.
    epsilon
        ε in (0, M_H²/L_H]. For larger ε, √(L_H ε) ≥ M_H, and the second-order condition is void.
    initial_gap
        J(θ_0) - J* or an upper bound. ``None``: 2K S_0, which always is an upper bound.

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

    The ε-SOSP is θ_k, the iterate after the first step with ‖s_k‖ ≤ ``sosp_step_norm`` =
    (3/8)√(ε/L_H). Step lengths are logged as ``train/step_norm``.

    Bernstein's inequality (Tropp, Found. Comput. Math. 12, 2012, Theorem 1.6) bounds all 2N errors.
    With δ' = δ/(2N) and ``n ≥ (8/3) log(2d/δ') max(M/u, σ²/u²)`` episodes, an error e > u has a
    probability of at most δ'. (M, σ) is (M_1, G_g) for g and (M_2, G_H) for H.

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
    name = "high_probability_recipe"
    epsilon, n_updates = _checked(name, constants, epsilon, initial_gap, _EXACT)
    delta = PROBABILITY(f"{name}: failure_probability", failure_probability)
    m, b = _bernstein(constants, epsilon, delta, n_updates, _EXACT)
    kwargs = {**batches(constants, m, b), "alpha": 3.0 * constants.L_H}
    max_step = _MAX_SOSP_STEP * math.sqrt(epsilon / constants.L_H)
    return Recipe(kwargs, n_updates, epsilon, constants.L_H, max_step)


def approximate_recipe(
    constants: Constants,
    epsilon: float,
    failure_probability: float,
    initial_gap: float | None = None,
) -> Recipe:
    """Return ACRPN's parameters, with which it stops at an ε-SOSP within N updates.

    α = ρ = L_H. Let Δ* be a global minimiser of the model and Δ the subsolver's step, in the units
    of this module's docstring. The iterates of gradient descent from 0 are not longer than the
    minimiser (Carmon and Duchi, SIAM J. Optim. 29, 2019). The perturbation σ = ε√(ρε)/ℓ adds at
    most √(2σ/ρ) to this length, which is 0.12 at the smallest ℓ used here, 150√(ρε). *Assumption*,
    which the tests measure: N̂ steps attain nine tenths of the perturbed model's largest decrease.

    - While -m(Δ) > 1/100, -m(Δ) ≥ 0.43·(-m(Δ*)) ≥ 0.43·‖Δ*‖³/12. With c_1 = 1/150 and c_2 = 1/200
      an update decreases J by 1/320. Hence N = 320 (J(θ_0) - J*) √ρ / ε^{3/2}.
    - Once -m(Δ) ≤ 1/100, ‖Δ*‖ ≤ 0.65. The final solver's step has ‖∇m‖ ≤ ε/2. It leads to
      ‖∇J‖ ≤ (½ + 0.65² + c_1 + 0.65c_2) ε < ε and -λ_min ≤ (1.5·0.65 + c_2)√(ρε) < √(ρε).

    A Cauchy step is taken only where ‖g‖ ≥ ℓ²/ρ. Its decrease -m(Δ) ≥ ⅓√(‖g‖³/ρ) is far larger.

    Differences from the paper: its σ = c'√(ερ)/ℓ has not the units of a gradient, ε√(ρε)/ℓ has. Its
    N̂ = 1/√ε lacks ℓ/√ρ and a logarithm. A direction of curvature -κ√(ρε) grows by the factor
    1 + κ√(ρε)/(20ℓ) a step, from σ/(20ℓ√d) to √(ε/ρ). Hence
    N̂ = (20/κ)(ℓ/√(ρε)) log(1 + 20√d ℓ²/(ρε)). κ = ¼, since a decrease of 1/100 has to be found
    and a curvature of -0.25√(ρε) alone allows it.

    Parameters
    ----------
    constants, epsilon, initial_gap
        As in :func:`expectation_recipe`.
    failure_probability
        δ in (0, 1), the failure probability of the estimates.

    Raises
    ------
    ValueError
        An argument is out of range.
    """
    name = "approximate_recipe"
    epsilon, n_updates = _checked(name, constants, epsilon, initial_gap, _APPROXIMATE)
    delta = PROBABILITY(f"{name}: failure_probability", failure_probability)
    m, b = _bernstein(constants, epsilon, delta, n_updates, _APPROXIMATE)
    curvature = math.sqrt(constants.L_H * epsilon)
    # ℓ bounds ‖H‖ ≤ M_H + c_2√(ρε)
    norm = constants.M_H / curvature + _APPROXIMATE.hessian
    condition = max(norm, _MIN_CONDITION)
    growth = math.log1p(_STEP_DIVISOR * math.sqrt(constants.d) * condition**2)
    kwargs = {
        **batches(constants, m, b),
        "alpha": constants.L_H,
        "sosp_epsilon": epsilon,
        "gradient_lipschitz": condition * curvature,
        "subsolver_steps": math.ceil(_STEP_DIVISOR / _RESOLVED_CURVATURE * condition * growth),
        "stop_at_sosp": True,
    }
    return Recipe(kwargs, n_updates, epsilon, constants.L_H)


def batches(constants: Constants, m: int, b: int) -> dict[str, Any]:
    """Return m, b, γ and H as keyword arguments of the algorithms."""
    return {
        "n_episodes": m,
        "n_hessian_episodes": b,
        "gamma": constants.gamma,
        "horizon": constants.H,
    }


def _checked(
    name: str, constants: Constants, epsilon: float, initial_gap: float | None, errors: _Errors
) -> tuple[float, int]:
    """Check the arguments. Return ε and the smallest N at which N decreases exceed J(θ_0) - J*."""
    constants = CONSTANTS(f"{name}: constants", constants)
    largest = constants.M_H**2 / constants.L_H
    epsilon = real(0.0, largest, open_low=True)(f"{name}: epsilon", epsilon)
    if initial_gap is None:
        initial_gap = 2.0 * constants.cost_bound
    initial_gap = POSITIVE(f"{name}: initial_gap", initial_gap)
    decrease = errors.decrease * epsilon * math.sqrt(epsilon / constants.L_H)
    return epsilon, math.floor(initial_gap / decrease) + 1


def _allowed_errors(constants: Constants, epsilon: float, errors: _Errors) -> tuple[float, float]:
    """Return c_1 ε and c_2 √(L_H ε)."""
    curvature = math.sqrt(constants.L_H * epsilon)
    return errors.gradient * epsilon, errors.hessian * curvature


def _bernstein(
    constants: Constants, epsilon: float, delta: float, n_updates: int, errors: _Errors
) -> tuple[int, int]:
    """Return m and b that bound the errors of all updates by Bernstein's inequality."""
    logarithm = math.log(4.0 * constants.d * n_updates / delta)

    def batch(max_deviation: float, std: float, error: float) -> int:
        return math.ceil(8 / 3 * logarithm * max(max_deviation / error, (std / error) ** 2))

    gradient_error, hessian_error = _allowed_errors(constants, epsilon, errors)
    return (
        batch(constants.M_1, constants.G_g, gradient_error),
        batch(constants.M_2, constants.G_H, hessian_error),
    )
