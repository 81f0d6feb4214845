r"""The constants and parameters that the paper prints, beside those derived in this package.

Maniyar, Prashanth L.A., Mondal and Bhatnagar, AISTATS 2024. Everything here is the text's own
formula, its slips included; `Constants` and the recipes without "printed" are derived anew, and
smaller but for two numbers (docs/THEORY.md, "Printed and derived"). What the formulas lack:

- b_k of the theorem in expectation lacks 1/L_H, and so does t_1 = ε/144, for which the proof needs
  L_H ε/18. The episodes are too few where L_H < 1 and L_H < 1/8.
- b_k ≥ 4(1 + 2 log 2d) is needed by the lemma on the errors and not asked for by the theorem.
- K H bounds Σ_{h<H} γ^h c_h. It does not bound the text's Σ_{h=0}^{H-1} γ^{h-1} c_h for γ < 1,
  which is 1/γ times as large: the constants are those of this package's J, not of the text's.
- With high probability the *mean* of ‖θ_k - θ_{k-1}‖³ over k is small. For one R drawn at random
  the proof has it in expectation over R only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from sb3_crpn.checks import COUNT, POSITIVE, integer
from sb3_crpn.theory.constants import Constants
from sb3_crpn.theory.recipes import CONSTANTS, PROBABILITY, Recipe, batches

# Theorem on the approximate solution: "c_1, c_2 = 1/300 and c_3, c_4 = 1/200"; c_2 is not used
C_1 = 1 / 300
C_3 = C_4 = 1 / 200

# 5√ε ≥ √‖∇J‖ and 5√ε ≥ -(5/7) λ_min/√L_H
_GUARANTEE = {"gradient_factor": 25.0, "curvature_factor": 7.0}


@dataclass(frozen=True)
class PrintedConstants:
    """What the paper prints for the K, G, L_1, L_2 (Assumptions 1-3), H and d of ``problem``.

    Beware of M_H: the text's bounds ‖∇J‖ and corresponds to :attr:`Constants.M_g`. The text's G_H
    bounds ‖∇²J‖, :attr:`Constants.M_H`, and one episode's estimate of it, :attr:`Constants.G_H`.
    """

    problem: Constants

    def __post_init__(self) -> None:
        CONSTANTS("PrintedConstants: problem", self.problem)

    @property
    def initial_gap(self) -> float:
        """J(θ_0) - J* ≤ 2 K H (Remark 1)."""
        return 2.0 * self._KH(1)

    @property
    def M_H(self) -> float:  # noqa: N802
        """‖∇J‖ ≤ K G H³ (Proposition 1). The proof of Lemma 2 has it with H²."""
        return self._KH(3) * self.problem.scores.G

    @property
    def G_H(self) -> float:  # noqa: N802
        """‖∇²J‖, ‖one episode's estimate‖ ≤ K (G² H³ + L_1 H²) (Proposition 1, Lemma 2)."""
        scores = self.problem.scores
        return self._KH(3) * scores.G**2 + self._KH(2) * scores.L_1

    @property
    def L_H(self) -> float:  # noqa: N802
        """The Lipschitz constant of ∇²J, K (G³ H⁴ + 3 G L_1 H³ + L_2 H²) (Proposition 1)."""
        G, L_1, L_2 = self.problem.scores.G, self.problem.scores.L_1, self.problem.scores.L_2
        return self._KH(4) * G**3 + 3.0 * self._KH(3) * G * L_1 + self._KH(2) * L_2

    @property
    def G_g(self) -> float:  # noqa: N802
        """‖one episode's estimate of ∇J‖ ≤ K G H² (Lemma 2)."""
        return self._KH(2) * self.problem.scores.G

    @property
    def M_1(self) -> float:  # noqa: N802
        """‖one episode's estimate of ∇J - ∇J‖ ≤ K G H² (H + 1) (Lemma 1)."""
        return self._KH(2) * self.problem.scores.G * (self.problem.H + 1)

    @property
    def M_2(self) -> float:  # noqa: N802
        """‖one episode's estimate of ∇²J - ∇²J‖ ≤ 2 G_H (Lemma 1)."""
        return 2.0 * self.G_H

    @property
    def least_hessian_episodes(self) -> int:
        """The least b_k for which the bound on H's error is stated: 4 (1 + 2 log 2d) (Lemma 5)."""
        return math.ceil(4.0 * self._logarithm)

    def gradient_error(self, n_episodes: int) -> float:
        """Bound (E‖g - ∇J‖²)^½ of the mean of m episodes: G_g/√m (Lemma 5)."""
        n_episodes = COUNT("gradient_error: n_episodes", n_episodes)
        return self.G_g / math.sqrt(n_episodes)

    def hessian_error(self, n_episodes: int) -> float:
        """Bound (E‖H - ∇²J‖³)^⅓ of b episodes: (4 √(15 (1 + 2 log 2d)) d G_H³)^⅓/√b (Lemma 5).

        The proof takes E max_τ‖Δ_τ‖² ≤ G_H² from E‖Δ_τ‖² ≤ G_H², which does not give it.

        Raises
        ------
        ValueError
            For fewer episodes than the lemma supposes.
        """
        allowed = integer(self.least_hessian_episodes)
        n_episodes = allowed("hessian_error: n_episodes", n_episodes)
        cube = 4.0 * math.sqrt(15.0 * self._logarithm) * self.problem.d * self.G_H**3
        return float(cube ** (1 / 3)) / math.sqrt(n_episodes)

    @property
    def _logarithm(self) -> float:
        """1 + 2 log 2d."""
        return 1.0 + 2.0 * math.log(2.0 * self.problem.d)

    def _KH(self, power: int) -> float:  # noqa: N802
        return self.problem.K * float(self.problem.H) ** power


def printed_expectation_recipe(
    constants: Constants, epsilon: float, initial_gap: float | None = None
) -> Recipe:
    """Return CRPN's parameters as printed in Theorem 2: E‖∇J(θ_R)‖ ≤ 25ε, E λ_min ≥ -7√(L_H ε).

    α = 3 L_H, N = 12 (J(θ_0) - J*) √L_H / ε^{3/2}, m = 25 G_g²/(4ε²),
    b = 36 (30 (1 + 2 log 2d))^⅓ d^⅔ G_H²/ε, each rounded up; R is uniform on 1, …, N. What the
    formulas lack is in this module's docstring.

    Parameters
    ----------
    constants
        Of the policy and the environment; K, G, L_1, L_2, H and d are read.
    epsilon
        ε > 0, of which the guarantee is a multiple: :attr:`Recipe.gradient_bound`.
    initial_gap
        J(θ_0) - J* or a bound on it; ``None``: 2 K H, with which N is Remark 1's
        24 K H √L_H / ε^{3/2}.

    Raises
    ------
    ValueError
        ``epsilon`` or ``initial_gap`` is out of range.
    """
    printed, epsilon, gap = _checked("printed_expectation_recipe", constants, epsilon, initial_gap)
    n_updates = _n_updates(printed, epsilon, gap, 12.0)
    m = math.ceil(25.0 * printed.G_g**2 / (4.0 * epsilon**2))
    root = (30.0 * (1.0 + 2.0 * math.log(2.0 * constants.d))) ** (1 / 3)
    b = math.ceil(36.0 * root * constants.d ** (2 / 3) * printed.G_H**2 / epsilon)
    kwargs = {**batches(constants, m, b), "alpha": 3.0 * printed.L_H}
    return Recipe(kwargs, n_updates, epsilon, printed.L_H, **_GUARANTEE)


def printed_high_probability_recipe(
    constants: Constants,
    epsilon: float,
    failure_probability: float,
    initial_gap: float | None = None,
) -> Recipe:
    """Return CRPN's parameters as printed in Theorem 3, of the same bounds with high probability.

    α and N are those of :func:`printed_expectation_recipe`, and with δ' = δ/(2N), of which the
    theorem makes the probability 1 - 2Nδ',

    m = max(M_1/t, M_1²/t²) (8/3) log(2d/δ'), b = max(M_2/√t_1, M_2²/t_1) (8/3) log(2d/δ').

    The theorem leaves t and t_1 free; its proof takes t = 2ε/5 and t_1 = ε/144, as done here.

    Parameters
    ----------
    constants, epsilon, initial_gap
        As in :func:`printed_expectation_recipe`.
    failure_probability
        δ = 2Nδ' in (0, 1).

    Raises
    ------
    ValueError
        An argument is out of range.
    """
    name = "printed_high_probability_recipe"
    printed, epsilon, gap = _checked(name, constants, epsilon, initial_gap)
    failure_probability = PROBABILITY(f"{name}: failure_probability", failure_probability)
    n_updates = _n_updates(printed, epsilon, gap, 12.0)
    logarithm = math.log(4.0 * constants.d * n_updates / failure_probability)
    gradient, hessian = printed.M_1 / (2.0 * epsilon / 5.0), printed.M_2 / math.sqrt(epsilon / 144)
    m = math.ceil(max(gradient, gradient**2) * 8 / 3 * logarithm)
    b = math.ceil(max(hessian, hessian**2) * 8 / 3 * logarithm)
    kwargs = {**batches(constants, m, b), "alpha": 3.0 * printed.L_H}
    return Recipe(kwargs, n_updates, epsilon, printed.L_H, **_GUARANTEE)


def printed_approximate_recipe(
    constants: Constants,
    epsilon: float,
    failure_probability: float,
    initial_gap: float | None = None,
) -> Recipe:
    """Return ACRPN's parameters as printed in Theorem 4, for an ε-SOSP with high probability.

    α = ρ = L_H, ℓ = G_H (Proposition 1), N̂ = 1/√ε and, with c_1 = 1/300, c_3 = c_4 = 1/200,

    m = max(M_1/(c_1 ε), M_1²/(c_3² ε²)) log(d √ρ/(ε^{3/2} δ' c_3)),
    b = max(M_2/(c_4 √(ρε)), M_2²/(c_4² ρε)) log(d √ρ/(ε^{3/2} δ' c_4)).

    N̂ lacks ℓ/√ρ and a logarithm, so that it has the units of ε^{-½}; the logarithms of m and b lack
    J(θ_0) - J*. The text has no c', for which ACRPN has σ = ε√(ρε)/ℓ, and no number of updates
    but its order. Here N̄ = 100 (J(θ_0) - J*) √ρ/ε^{3/2}: until it ends, every update predicts a
    decrease of more than (1/100) √(ε³/ρ).

    Parameters
    ----------
    constants, epsilon, initial_gap
        As in :func:`printed_expectation_recipe`.
    failure_probability
        δ' in (0, 1).

    Raises
    ------
    ValueError
        An argument is out of range.
    """
    name = "printed_approximate_recipe"
    printed, epsilon, gap = _checked(name, constants, epsilon, initial_gap)
    failure_probability = PROBABILITY(f"{name}: failure_probability", failure_probability)
    n_updates = _n_updates(printed, epsilon, gap, 100.0)
    gradient, hessian = printed.M_1 / epsilon, printed.M_2 / math.sqrt(printed.L_H * epsilon)
    argument = constants.d * math.sqrt(printed.L_H) / (epsilon**1.5 * failure_probability)
    m = math.ceil(max(gradient / C_1, (gradient / C_3) ** 2) * math.log(argument / C_3))
    b = math.ceil(max(hessian / C_4, (hessian / C_4) ** 2) * math.log(argument / C_4))
    kwargs = {
        **batches(constants, m, b),
        "alpha": printed.L_H,
        "sosp_epsilon": epsilon,
        "gradient_lipschitz": printed.G_H,
        "subsolver_steps": math.ceil(1.0 / math.sqrt(epsilon)),
        "stop_at_sosp": True,
    }
    return Recipe(kwargs, n_updates, epsilon, printed.L_H)


def printed_approximate_complexity(
    constants: Constants, epsilon: float, initial_gap: float | None = None
) -> tuple[float, float]:
    """Return what Theorem 4's O(·) holds: gradients of episodes and Hessian-vector products.

    χ√ρ/ε^{3/2} max(M_1/ε, M_1²/ε²) and χ√ρ/ε^{3/2} max(M_2/√(ρε), M_2²/(ρε))/√ε, χ ≥ J(θ_0) - J*:
    ε^{-7/2} and ε^{-3} as ε → 0 (Remark 3). Without 1/√ε = N̂ the latter is the number of episodes.

    Those of Theorems 2 and 3 are :attr:`Recipe.gradient_episodes` and
    :attr:`Recipe.hessian_episodes` (Remark 2).
    """
    name = "printed_approximate_complexity"
    printed, epsilon, gap = _checked(name, constants, epsilon, initial_gap)
    gradient, hessian = printed.M_1 / epsilon, printed.M_2 / math.sqrt(printed.L_H * epsilon)
    updates = gap * math.sqrt(printed.L_H) / epsilon**1.5
    return (
        updates * max(gradient, gradient**2),
        updates * max(hessian, hessian**2) / math.sqrt(epsilon),
    )


def _checked(
    function: str, constants: Constants, epsilon: float, initial_gap: float | None
) -> tuple[PrintedConstants, float, float]:
    """Return the printed constants, ε and J(θ_0) - J* or its bound, for good arguments."""
    printed = PrintedConstants(CONSTANTS(f"{function}: constants", constants))
    gap = printed.initial_gap if initial_gap is None else initial_gap
    epsilon = POSITIVE(f"{function}: epsilon", epsilon)
    return printed, epsilon, POSITIVE(f"{function}: initial_gap", gap)


def _n_updates(printed: PrintedConstants, epsilon: float, gap: float, factor: float) -> int:
    """Return ⌈factor (J(θ_0) - J*) √L_H / ε^{3/2}⌉."""
    return math.ceil(factor * gap * math.sqrt(printed.L_H / epsilon) / epsilon)
