import math
from dataclasses import replace

import pytest
import torch

from sb3_crpn.algorithm.solvers import SOLVERS, ApproximateSolver, DenseSolver, KrylovSolver
from sb3_crpn.cubic import cubic_finalsolver, cubic_subsolver, solve_dense
from sb3_crpn.curvature import (
    Causal,
    Constant,
    Euclidean,
    FullModel,
    estimate_curvature,
    subspace_model,
)
from tests.policies import frozen_episodes, small_policy

ALPHA = 3.0


@pytest.fixture(scope="module")
def estimate():
    policy, actor = small_policy("discrete")
    return estimate_curvature(policy, actor, frozen_episodes(policy), Causal(0.9))


@pytest.mark.parametrize("solver", [DenseSolver(), KrylovSolver(tol=1e-10)])
@pytest.mark.parametrize("full", [True, False])
def test_exact_solvers_find_the_global_minimiser(estimate, solver, full):
    model = (
        FullModel(estimate, 0.5) if full else subspace_model(estimate, Euclidean(), Constant(0.5))
    )
    expected = solve_dense(estimate.gradient, 0.5 * estimate.hessian.to_dense(), ALPHA)
    step = solver.solve(model, ALPHA)
    assert step.certified
    torch.testing.assert_close(model.to_parameters(step.step), expected.step, rtol=1e-6, atol=1e-8)


def test_the_automatic_solver_writes_small_hessians_out():
    auto = SOLVERS.resolve("auto", None)
    assert auto.needs_matrix(64)
    assert not auto.needs_matrix(65)
    assert SOLVERS.resolve("dense", None).needs_matrix(10**6)
    assert not SOLVERS.resolve("krylov", None).needs_matrix(1)
    assert not ApproximateSolver(None, 1.0, 1, 0).needs_matrix(1)


@pytest.mark.parametrize("epsilon", [1e-4, 1e4])
@pytest.mark.parametrize("lipschitz", [None, 50.0])
@pytest.mark.parametrize("full", [True, False])
def test_the_approximate_solver_is_algorithm_2(estimate, epsilon, lipschitz, full):
    model = FullModel(estimate, 1.0) if full else subspace_model(estimate, Euclidean(), Constant())
    solver = ApproximateSolver(lipschitz, epsilon, 30, seed=4)
    step = solver.solve(model, ALPHA)
    assert step.at_sosp == (epsilon == 1e4)
    if lipschitz is None and not full:  # ‖H‖ is known there
        lipschitz = float(torch.linalg.eigvalsh(model.hessian).abs().max())
    problem = (model.gradient, model.product, ALPHA)
    options = {"gradient_lipschitz": lipschitz, "epsilon": epsilon, "max_steps": 30}
    first = cubic_subsolver(*problem, seed=4, **options)
    assert step.at_sosp == (first.predicted_decrease <= math.sqrt(epsilon**3 / ALPHA) / 100)
    expected = cubic_finalsolver(*problem, **options) if step.at_sosp else first
    torch.testing.assert_close(step.step, expected.step, rtol=1e-10, atol=1e-12)
    assert replace(step, at_sosp=False).status == expected.status
