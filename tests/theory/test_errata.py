"""Errata of the paper, each shown by a number (docs/THEORY.md, "Errata")."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sb3_crpn.cubic import cubic_finalsolver, cubic_subsolver
from sb3_crpn.theory import (
    Constants,
    PrintedConstants,
    ScoreBounds,
    approximate_recipe,
    printed_approximate_recipe,
    printed_expectation_recipe,
    printed_high_probability_recipe,
    softmax_linear,
)

UNIT = Constants(1.0, ScoreBounds(1.0, 1.0, 1.0), H=1, d=4)


@pytest.mark.parametrize(("K", "enough"), [(1.0, True), (0.21, True), (0.19, False), (0.01, False)])
def test_the_printed_b_is_enough_where_the_lipschitz_constant_is_at_least_one(K, enough):
    """The proof needs E‖H - ∇²J‖³ ≤ (2 · 4 L_H · ε/144)^{3/2}; here L_H = 5K."""
    problem = replace(UNIT, K=K)
    printed, epsilon = PrintedConstants(problem), 1e-4
    b = printed_expectation_recipe(problem, epsilon).kwargs["n_hessian_episodes"]
    needed = math.sqrt(8.0 * printed.L_H * epsilon / 144.0)
    assert (printed.hessian_error(b) <= needed) == enough


@pytest.mark.parametrize(("K", "enough"), [(1.0, True), (0.026, True), (0.024, False)])
def test_the_printed_t_1_is_enough_where_the_lipschitz_constant_is_an_eighth(K, enough):
    """By Bernstein's inequality, 2d exp(-(3b/8) min(u/M_2, u²/M_2²)) ≤ δ'."""
    problem, epsilon, delta = replace(UNIT, K=K), 1e-6, 0.1
    printed = PrintedConstants(problem)
    recipe = printed_high_probability_recipe(problem, epsilon, delta)
    part = math.sqrt(8.0 * printed.L_H * epsilon / 144.0) / printed.M_2
    exponent = 3 / 8 * recipe.kwargs["n_hessian_episodes"] * min(part, part**2)
    tail = 2 * problem.d * math.exp(-exponent)
    assert (tail <= delta / (2 * recipe.n_updates)) == enough


def test_the_theorem_does_not_ask_for_the_episodes_that_its_lemma_supposes():
    problem = replace(UNIT, K=0.01)
    printed = PrintedConstants(problem)
    b = printed_expectation_recipe(problem, 0.5).kwargs["n_hessian_episodes"]
    assert b < printed.least_hessian_episodes
    with pytest.raises(ValueError, match="n_episodes"):
        printed.hessian_error(b)


def test_the_printed_discounts_add_up_to_more_than_the_horizon():
    H, gamma = 2, 0.5
    assert sum(gamma ** (h - 1) for h in range(H)) == 3.0 > H
    problem = replace(UNIT, H=H, gamma=gamma)
    assert sum(gamma**h for h in range(H)) == problem.cost_bound <= H


def printed_finalsolver(gradient, hessian, rho, lipschitz, epsilon, max_steps):
    """Algorithm 2's Finalsolver as printed: ḡ_J ← ḡ_J + H[Δ] + (ρ/2)‖Δ‖Δ."""
    step, slope = np.zeros_like(gradient), gradient.copy()
    for _ in range(max_steps):
        if np.linalg.norm(slope) < epsilon / 2:
            return step
        step = step - slope / (20 * lipschitz)
        slope = slope + hessian @ step + rho / 2 * np.linalg.norm(step) * step
    return None


def test_the_printed_finalsolver_may_stop_but_hardly_ever_at_a_small_slope():
    """It stops within 500 steps in 24 of 200 problems, in 23 of them where ‖∇m‖ > ε/2."""
    rng, epsilon, slopes = np.random.default_rng(0), 0.5, []
    for _ in range(200):
        A, gradient = rng.normal(size=(5, 5)), rng.normal(size=5)
        hessian = (A + A.T) / math.sqrt(20)
        gradient *= rng.uniform(0.5, 1.0) / np.linalg.norm(gradient)
        lipschitz = max(1.0, np.linalg.norm(hessian, 2))
        step = printed_finalsolver(gradient, hessian, 1.0, lipschitz, epsilon, 500)
        if step is not None:
            slope = gradient + hessian @ step + np.linalg.norm(step) / 2 * step
            slopes.append(np.linalg.norm(slope))
            H = torch.from_numpy(hessian)
            options = {"gradient_lipschitz": lipschitz, "epsilon": epsilon, "max_steps": 5000}
            corrected = cubic_finalsolver(gradient, lambda v, H=H: H @ v, 1.0, **options)
            assert corrected.residual <= epsilon / 2
    assert 15 < len(slopes) < 50
    assert sum(slope > epsilon / 2 for slope in slopes) > 0.9 * len(slopes)
    assert max(slopes) > 2 * epsilon


def test_the_printed_number_of_inner_steps_depends_on_the_unit_of_reward():
    """Costs in cents in place of euros change ε, and no other number."""
    cents = replace(UNIT, K=100.0)
    theirs = [printed_approximate_recipe(p, 0.01 * p.K, 0.5) for p in (UNIT, cents)]
    assert [recipe.kwargs["subsolver_steps"] for recipe in theirs] == [10, 1]
    ours = [approximate_recipe(p, 0.01 * p.K, 0.5) for p in (UNIT, cents)]
    assert ours[0].kwargs["subsolver_steps"] == ours[1].kwargs["subsolver_steps"]


def test_the_printed_number_of_inner_steps_misses_a_saddle():
    """λ_min = -2√(ρε) and g = 0: Algorithm 2 would stop here, at a point that is not an ε-SOSP."""
    problem = Constants(1.0, softmax_linear(1.0), 2, 6)
    recipe = printed_approximate_recipe(problem, 0.02, 0.05)
    rho, epsilon = recipe.rho, recipe.epsilon
    curvatures = torch.tensor([-2.0 * math.sqrt(rho * epsilon), 1.0, 1.0], dtype=torch.float64)
    arguments = (torch.zeros(3), lambda v: curvatures * v, rho)
    options = {"gradient_lipschitz": recipe.kwargs["gradient_lipschitz"], "epsilon": epsilon}
    enough = math.sqrt(epsilon**3 / rho) / 100
    few = cubic_subsolver(*arguments, max_steps=recipe.kwargs["subsolver_steps"], **options)
    assert few.predicted_decrease < 1e-3 * enough
    assert cubic_subsolver(*arguments, **options).predicted_decrease > enough
