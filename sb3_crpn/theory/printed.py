r"""The constants and parameters as printed in the paper.

Maniyar, Prashanth L.A., Mondal and Bhatnagar, AISTATS 2024. This module implements the formulas of
the text, including its errata. `Constants` and the recipes without "printed" in their names are
derived in this package. All derived values but two are smaller (docs/THEORY.md, "Printed and
derived"). Errata of the formulas:

- Theorem 2: b_k lacks the factor 1/L_H. It is too small where L_H < 1.
- Theorem 3: t_1 = ε/144 lacks the factor L_H. The proof needs L_H ε/18. b_k is too small where
  L_H < 1/8.
- Theorem 2 omits the condition b_k ≥ 4(1 + 2 log 2d) of its Lemma 5.
- K H bounds Σ_{h<H} γ^h c_h. For γ < 1 it does not bound the text's Σ_{h=0}^{H-1} γ^{h-1} c_h,
  which is 1/γ times as large. The constants therefore belong to this package's J.
- Theorem 3: the proof bounds the *mean* of ‖θ_k - θ_{k-1}‖³ over k with high probability. For a
  random R it bounds the expectation over R only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from sb3_crpn.checks import COUNT, POSITIVE, integer
from sb3_crpn.theory.constants import Constants
from sb3_crpn.theory.recipes import CONSTANTS, PROBABILITY, Recipe, batches

# Theorem 4: "c_1, c_2 = 1/300 and c_3, c_4 = 1/200". The formulas do not contain c_2
C_1 = 1 / 300
C_3 = C_4 = 1 / 200

# 5√ε ≥ √‖∇J‖ and 5√ε ≥ -(5/7) λ_min/√L_H
_GUARANTEE = {"gradient_factor": 25.0, "curvature_factor": 7.0}


@dataclass(frozen=True)
class PrintedConstants:
    """The paper's constants for the K, G, L_1, L_2 (Assumptions 1-3), H and d of ``problem``.

    Two symbols differ from :class:`Constants`. The text's M_H bounds ‖∇J‖ and corresponds to
    :attr:`Constants.M_g`. The text's G_H bounds both ‖∇²J‖ (:attr:`Constants.M_H`) and one
    episode's estimate of ∇²J (:attr:`Constants.G_H`).
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
        """‖∇J‖ ≤ K G H³ (Proposition 1). The proof of Lemma 2 shows the bound with H²."""
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
        """The minimum b_k of the bound on H's error, 4 (1 + 2 log 2d) (Lemma 5)."""
        return math.ceil(4.0 * self._logarithm)

    def gradient_error(self, n_episodes: int) -> float:
        """Bound (E‖g - ∇J‖²)^½ of the mean of m episodes: G_g/√m (Lemma 5)."""
        n_episodes = COUNT("gradient_error: n_episodes", n_episodes)
        return self.G_g / math.sqrt(n_episodes)

    def hessian_error(self, n_episodes: int) -> float:
        """Bound (E‖H - ∇²J‖³)^⅓ of b episodes: (4 √(15 (1 + 2 log 2d)) d G_H³)^⅓/√b (Lemma 5).

        The proof uses E max_τ‖Δ_τ‖² ≤ G_H², which does not follow from E‖Δ_τ‖² ≤ G_H².

        Raises
        ------
        ValueError
            ``n_episodes`` is below :attr:`least_hessian_episodes`.
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
    b = 36 (30 (1 + 2 log 2d))^⅓ d^⅔ G_H²/ε, each rounded up. R is uniform on 1, …, N. The module's
    docstring lists the errata.

    Parameters
    ----------
    constants
        Constants of the policy and the environment. K, G, L_1, L_2, H and d are read.
    epsilon
        ε > 0. The guarantee is a multiple of it: :attr:`Recipe.gradient_bound`.
    initial_gap
        J(θ_0) - J* or an upper bound. ``None``: 2 K H, which gives Remark 1's
        N = 24 K H √L_H / ε^{3/2}.

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
    """Return CRPN's parameters as printed in Theorem 3: the same bounds with high probability.

    α and N are those of :func:`printed_expectation_recipe`. With δ' = δ/(2N), hence the theorem's
    probability 1 - 2Nδ' = 1 - δ,

    m = max(M_1/t, M_1²/t²) (8/3) log(2d/δ'), b = max(M_2/√t_1, M_2²/t_1) (8/3) log(2d/δ').

    The theorem does not fix t and t_1. t = 2ε/5 and t_1 = ε/144 are those of its proof.

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

    N̂ lacks ℓ/√ρ and a logarithm, and therefore has the units of ε^{-½}. The logarithms of m and b
    lack J(θ_0) - J*. The text does not define c'; ACRPN uses σ = ε√(ρε)/ℓ. The text gives the order
    of the number of updates only. N = 100 (J(θ_0) - J*) √ρ/ε^{3/2} is used here, since before its
    end every update predicts a decrease of more than (1/100) √(ε³/ρ).

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
    """Return the arguments of Theorem 4's O(·): episode gradients and Hessian-vector products.

    χ√ρ/ε^{3/2} max(M_1/ε, M_1²/ε²) and χ√ρ/ε^{3/2} max(M_2/√(ρε), M_2²/(ρε))/√ε, χ ≥ J(θ_0) - J*.
    Their orders are ε^{-7/2} and ε^{-3} as ε → 0 (Remark 3). The factor 1/√ε is N̂. Without it the
    second number is that of the episodes.

    The numbers of Theorems 2 and 3 are :attr:`Recipe.gradient_episodes` and
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
    """Check the arguments. Return the printed constants, ε and J(θ_0) - J* or its bound."""
    printed = PrintedConstants(CONSTANTS(f"{function}: constants", constants))
    gap = printed.initial_gap if initial_gap is None else initial_gap
    epsilon = POSITIVE(f"{function}: epsilon", epsilon)
    return printed, epsilon, POSITIVE(f"{function}: initial_gap", gap)


def _n_updates(printed: PrintedConstants, epsilon: float, gap: float, factor: float) -> int:
    """Return ⌈factor (J(θ_0) - J*) √L_H / ε^{3/2}⌉."""
    return math.ceil(factor * gap * math.sqrt(printed.L_H / epsilon) / epsilon)
