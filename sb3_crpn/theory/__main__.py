"""Print the paper's constants and parameters beside the derived ones: the table of docs/THEORY.md.

python -m sb3_crpn.theory
"""

from __future__ import annotations

from collections.abc import Iterator

from sb3_crpn.theory import (
    Constants,
    PrintedConstants,
    approximate_recipe,
    expectation_recipe,
    gaussian_linear,
    high_probability_recipe,
    printed_approximate_recipe,
    printed_expectation_recipe,
    printed_high_probability_recipe,
    softmax_linear,
)
from sb3_crpn.theory.recipes import Recipe

FAILURE_PROBABILITY = 0.05
_SOFTMAX = softmax_linear(1.0)
_GAUSSIAN = gaussian_linear(1.0, 0.5, 2, n_actions=10**7, failure_probability=FAILURE_PROBABILITY)
# A two-armed bandit, the coordination MDP, and longer episodes
PROBLEMS = {
    "softmax, H = 1, d = 4, gamma = 1": Constants(1.0, _SOFTMAX, 1, 4),
    "softmax, H = 2, d = 6, gamma = 1": Constants(1.0, _SOFTMAX, 2, 6),
    "softmax, H = 10, d = 10, gamma = 1": Constants(1.0, _SOFTMAX, 10, 10),
    "softmax, H = 10, d = 10, gamma = 0.9": Constants(1.0, _SOFTMAX, 10, 10, 0.9),
    "softmax, H = 500, d = 10, gamma = 0.99": Constants(1.0, _SOFTMAX, 500, 10, 0.99),
    "Gaussian, H = 50, d = 22, gamma = 0.99": Constants(1.0, _GAUSSIAN, 50, 22, 0.99),
}
# Recipes are compared at the same bound on ‖∇J‖. It is this fraction of M_H²/L_H, beyond which the
# second-order condition is void
EPSILON_FRACTION = 0.1


def table() -> str:
    """Return the Markdown table: a row per number, "printed / derived = ratio" per problem."""
    columns = [dict(numbers(problem)) for problem in PROBLEMS.values()]
    lines = [f"| | {' | '.join(PROBLEMS)} |", "|---" * (len(PROBLEMS) + 1) + "|"]
    for name in columns[0]:
        cells = " | ".join(_cell(*column[name]) for column in columns)
        lines.append(f"| {name} | {cells} |")
    return "\n".join(lines)


def numbers(problem: Constants) -> Iterator[tuple[str, tuple[float, float]]]:
    """Yield the name, the printed value and the derived value of each number."""
    printed = PrintedConstants(problem)
    yield "‖∇J‖ ≤", (printed.M_H, problem.M_g)
    yield "‖∇²J‖ ≤", (printed.G_H, problem.M_H)
    for name in ("L_H", "G_g", "G_H", "M_1", "M_2"):
        yield name, (getattr(printed, name), getattr(problem, name))
    yield "(E‖g - ∇J‖²)^½ √m", (printed.gradient_error(1), problem.gradient_error(1))
    b = printed.least_hessian_episodes
    errors = (printed.hessian_error(b) * b**0.5, problem.hessian_error(b) * b**0.5)
    yield "(E‖H - ∇²J‖³)^⅓ √b", errors
    for name, recipes in recipe_pairs(problem).items():
        yield f"{name}: N", (recipes[0].n_updates, recipes[1].n_updates)
        yield f"{name}: Σ m_k", (recipes[0].gradient_episodes, recipes[1].gradient_episodes)
        yield f"{name}: Σ b_k", (recipes[0].hessian_episodes, recipes[1].hessian_episodes)
    steps = [recipe.kwargs["subsolver_steps"] for recipe in recipes]  # of the last, ACRPN's
    yield f"{name}: N̂", (steps[0], steps[1])


def recipe_pairs(problem: Constants) -> dict[str, tuple[Recipe, Recipe]]:
    """Return the printed and the derived recipe of each theorem, with equal bounds on ‖∇J‖."""
    epsilon, delta = EPSILON_FRACTION * problem.M_H**2 / problem.L_H, FAILURE_PROBABILITY
    finer = epsilon / 25.0
    return {
        "expectation": (
            printed_expectation_recipe(problem, finer),
            expectation_recipe(problem, epsilon),
        ),
        "high probability": (
            printed_high_probability_recipe(problem, finer, delta),
            high_probability_recipe(problem, epsilon, delta),
        ),
        "approximate": (
            printed_approximate_recipe(problem, epsilon, delta),
            approximate_recipe(problem, epsilon, delta),
        ),
    }


def _cell(printed: float, derived: float) -> str:
    return f"{printed:.3g} / {derived:.3g} = {printed / derived:.3g}"


if __name__ == "__main__":
    print(table())
