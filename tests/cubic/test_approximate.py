import math
from decimal import Decimal, localcontext
from itertools import pairwise

import numpy as np
import pytest
import torch

from sb3_crpn.cubic import approximate, cubic_finalsolver, cubic_subsolver, solve_dense
from sb3_crpn.cubic.approximate import cauchy_radius, estimate_lipschitz
from tests.cubic.problems import FAMILY, Counter, Problem, each_problem, model, spectral

SOLVERS = [cubic_subsolver, cubic_finalsolver]


def norm(H):
    return float(np.linalg.norm(H, 2))


def assert_honest(problem, result, hvp):
    """The fields of a step agree with H and g. The step is not certified."""
    s = result.step.numpy()
    assert np.isfinite(s).all()
    length = np.linalg.norm(s)
    scale = norm(problem.hessian) + result.multiplier
    rounding = 1e-14 * length * (length * scale + np.linalg.norm(problem.gradient))
    assert result.predicted_decrease == pytest.approx(-model(problem, s), rel=1e-9, abs=rounding)
    assert result.multiplier == pytest.approx(problem.alpha / 2 * length)
    residual = problem.gradient + problem.hessian @ s + result.multiplier * s
    assert result.residual == pytest.approx(
        np.linalg.norm(residual), rel=1e-9, abs=1e-14 * scale * length
    )
    assert result.products == len(hvp.calls)
    assert not result.certified
    assert math.isnan(result.lambda_min)


def assert_cauchy(problem, result):
    """No step along -g is better."""
    g = problem.gradient
    best = -result.predicted_decrease
    length = float(result.step.norm())
    radii = length * np.r_[np.linspace(0, 3, 301), 1 - 1e-4, 1 + 1e-4]
    values = [model(problem, -r * g / np.linalg.norm(g)) for r in radii]
    assert best <= 0
    assert best <= min(values) + 1e-10 * abs(best)
    assert float(result.step @ torch.from_numpy(g)) <= 0


@each_problem
@pytest.mark.parametrize("solver", SOLVERS)
def test_family(problem, solver):
    hvp = problem.hvp()
    result = solver(problem.gradient, hvp, problem.alpha, max_steps=50)
    assert_honest(problem, result, hvp)
    best = solve_dense(problem.gradient, problem.hessian, problem.alpha).predicted_decrease
    slack = 1e-10 * best + 1e-14 * norm(problem.hessian) * float(result.step.norm()) ** 2
    assert result.predicted_decrease <= best + slack
    if solver is cubic_finalsolver:
        assert result.predicted_decrease >= -slack  # it descends on the model itself


LARGE_GRADIENT = [p for p in FAMILY if p.alpha * norm(p.gradient) > norm(p.hessian) ** 2]


@pytest.mark.parametrize("problem", LARGE_GRADIENT, ids=lambda p: p.name)
def test_large_gradient_takes_the_cauchy_step(problem):
    lipschitz = norm(problem.hessian)
    hvp = problem.hvp()
    result = cubic_subsolver(problem.gradient, hvp, problem.alpha, gradient_lipschitz=lipschitz)
    assert result.status == "Cauchy step"
    assert result.products == 1
    assert_cauchy(problem, result)


@pytest.mark.parametrize("h", [1e8, 1.0, 0.0, -1.0, -1e8])
@pytest.mark.parametrize("g", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize("rho", [1e-4, 1e6])
def test_cauchy_radius_has_no_cancellation(h, g, rho):
    radius = cauchy_radius(g, h, rho)
    with localcontext() as context:
        context.prec = 80
        g, h, rho = Decimal(g), Decimal(h), Decimal(rho)
        expected = float((-h + (h * h + 2 * rho * g).sqrt()) / rho)
    assert radius == pytest.approx(expected, rel=1e-14)


def test_subsolver_escapes_a_saddle_it_cannot_see():
    problem = spectral("", [-1.0, 0.5, 1.0], [0.0, 1e-3, 1e-3])
    best = solve_dense(problem.gradient, problem.hessian, 1.0)
    hvp = problem.hvp()
    result = cubic_subsolver(problem.gradient, hvp, 1.0, gradient_lipschitz=1.0)
    assert_honest(problem, result, hvp)
    assert "converged" in result.status
    assert result.predicted_decrease >= 0.99 * best.predicted_decrease
    # the final solver has no perturbation and stays at the saddle
    stuck = cubic_finalsolver(problem.gradient, problem.hvp(), 1.0, gradient_lipschitz=1.0)
    assert stuck.predicted_decrease < 1e-3 * best.predicted_decrease


@pytest.mark.parametrize("seed", range(5))
def test_default_steps_suffice_for_curvature_beyond_epsilon(seed):
    # Tripuraneni et al. 2018: the decrease is at least of the order √(ε³/ρ) where λ_1 ≤ -√(ρε)
    rho, epsilon = 1.0, 1e-2
    eigenvalues = np.r_[-2 * math.sqrt(rho * epsilon), np.linspace(0, 1, 19)]
    problem = spectral("", eigenvalues, np.zeros(20), rho, seed)
    result = cubic_subsolver(problem.gradient, problem.hvp(), rho, epsilon=epsilon, seed=seed)
    assert result.predicted_decrease >= math.sqrt(epsilon**3 / rho) / 100


def test_perturbation_has_the_units_of_a_gradient():
    problem = spectral("", [-1.0, 1.0], [0.0, 1e-2])
    rho, lipschitz, epsilon = 2.0, 3.0, 0.05
    hvp = problem.hvp()
    cubic_subsolver(
        problem.gradient, hvp, rho, gradient_lipschitz=lipschitz, epsilon=epsilon, max_steps=1
    )
    perturbed = -20 * lipschitz * hvp.calls[0]
    sigma = epsilon * math.sqrt(rho * epsilon) / lipschitz
    assert float((perturbed - torch.from_numpy(problem.gradient)).norm()) == pytest.approx(sigma)


def test_finalsolver_follows_the_corrected_recursion():
    problem = spectral("", [-1.0, 0.3, 2.0], [0.1, -0.2, 0.3], 1.5, seed=0)
    hvp = problem.hvp()
    cubic_finalsolver(problem.gradient, hvp, 1.5, gradient_lipschitz=2.0, epsilon=1e-6, max_steps=5)
    H, g = hvp.hessian, torch.from_numpy(problem.gradient)
    for step, following in pairwise([torch.zeros(3, dtype=torch.float64), *hvp.calls]):
        slope = g + H @ step + 0.75 * step.norm() * step
        torch.testing.assert_close(following, step - slope / 40)


@pytest.mark.parametrize("epsilon", [1e-1, 1e-3, 1e-6])
def test_finalsolver_meets_its_tolerance(epsilon):
    problem = spectral("", np.linspace(0.1, 1, 8), np.ones(8) / 8, seed=1)
    hvp = problem.hvp()
    result = cubic_finalsolver(problem.gradient, hvp, 1.0, epsilon=epsilon, max_steps=10_000)
    assert_honest(problem, result, hvp)
    assert "converged in" in result.status
    assert result.residual <= epsilon / 2


@pytest.mark.parametrize("gradient", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize("lipschitz", [0.0, 1e-6])
def test_finalsolver_with_little_or_no_curvature(gradient, lipschitz):
    problem = Problem("", np.full(4, gradient / 2), np.zeros((4, 4)), 1.0)
    result = cubic_finalsolver(
        problem.gradient, problem.hvp(), 1.0, gradient_lipschitz=lipschitz, epsilon=1e-3 * gradient
    )
    expected = solve_dense(problem.gradient, problem.hessian, 1.0)
    torch.testing.assert_close(result.step, expected.step, rtol=1e-3, atol=0)


def test_no_gradient_and_no_curvature():
    for solver in SOLVERS:
        for lipschitz in (None, 0.0):
            result = solver(np.zeros(3), lambda v: 0 * v, 1.0, gradient_lipschitz=lipschitz)
            assert not result.step.any()
            assert result.predicted_decrease == result.residual == 0


def test_running_out_of_steps_is_a_status():
    problem = spectral("", [-1.0, 1.0], [1e-3, 1e-2])
    for solver in SOLVERS:
        hvp = problem.hvp()
        result = solver(
            problem.gradient, hvp, 1.0, gradient_lipschitz=1.0, epsilon=1e-9, max_steps=7
        )
        assert result.status == "descent stopped at step 7"
        assert result.products == 7
        assert_honest(problem, result, hvp)


def test_a_lipschitz_constant_far_too_small_is_a_status():
    problem = spectral("", [1.0, 100.0], [1e-6, 1e-6])
    for solver in SOLVERS:
        result = solver(problem.gradient, problem.hvp(), 1.0, gradient_lipschitz=1e-2, epsilon=1e-7)
        assert result.status == "diverged: gradient_lipschitz < ‖H‖, 0.01 used"
        assert not result.step.any()
        assert result.predicted_decrease == 0


@pytest.mark.parametrize("scale", [1e-156, 1e-158, 1e-160, 1e-163])
def test_a_hessian_that_all_but_vanishes_leads_nowhere(scale):
    """Where the step overflows, no product is asked for."""
    gradient = torch.zeros(10, dtype=torch.float64)
    result = cubic_subsolver(
        gradient, lambda vector: scale * vector, 0.1, gradient_lipschitz=scale, max_steps=50
    )
    assert not result.step.any()


def test_global_generators_are_untouched_and_the_seed_decides():
    problem = spectral("", [-1.0, 1.0, 2.0], [0.0, 0.1, 0.1])
    state = torch.random.get_rng_state()
    steps = [cubic_subsolver(problem.gradient, problem.hvp(), 1.0, seed=s).step for s in (0, 0, 3)]
    cubic_finalsolver(problem.gradient, problem.hvp(), 1.0)
    assert torch.equal(state, torch.random.get_rng_state())
    assert torch.equal(steps[0], steps[1])
    assert not torch.equal(steps[0], steps[2])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(gradient=np.array([np.nan])), "gradient has 1 NaN"),
        (dict(alpha=0.0), "alpha=0.0"),
        (dict(epsilon=0.0), "epsilon=0.0"),
        (
            dict(gradient_lipschitz=-1.0),
            r"gradient_lipschitz=-1.0 .* a finite number in \[0, inf\) or None",
        ),
        (dict(gradient_lipschitz=math.nan), "gradient_lipschitz=nan"),
        (dict(max_steps=0), "max_steps=0 is not allowed, must be an integer >= 1"),
    ],
)
@pytest.mark.parametrize("solver", SOLVERS)
def test_bad_input(solver, change, message):
    arguments = dict(gradient=np.ones(2), hvp=lambda v: v, alpha=1.0) | change
    with pytest.raises(ValueError, match=message):
        solver(**arguments)


# estimate_lipschitz


@pytest.mark.parametrize("dim", [1, 2, 10, 400])
@pytest.mark.parametrize("spectrum", ["uniform", "decaying", "negative", "zero"])
def test_lipschitz_estimate(dim, spectrum):
    eigenvalues = {
        "uniform": np.linspace(-1, 1, dim),
        "decaying": np.logspace(0, -6, dim),
        "negative": -np.logspace(0, -6, dim),
        "zero": np.zeros(dim),
    }[spectrum]
    hvp = Counter(torch.diag(torch.from_numpy(eigenvalues)))
    for seed in range(5):
        estimate = estimate_lipschitz(hvp, torch.zeros(dim, dtype=torch.float64), seed=seed)
        largest = np.abs(eigenvalues).max()
        assert largest * (1 - 1e-12) <= estimate <= 1.6 * largest
    assert len(hvp.calls) <= 5 * 10


def test_lipschitz_estimate_takes_ten_products():
    hvp = Counter(torch.diag(torch.linspace(-1, 1, 50, dtype=torch.float64)))
    estimate_lipschitz(hvp, torch.zeros(50, dtype=torch.float64))
    assert len(hvp.calls) == 10


# Mutants: the judges have to detect broken solvers.


@pytest.mark.parametrize(
    "mutant",
    [
        lambda norm, h, rho: -cauchy_radius(norm, h, rho),
        lambda norm, h, rho: cauchy_radius(norm, -h, rho),
        lambda norm, h, rho: cauchy_radius(norm, h, 2 * rho),
        lambda norm, h, rho: 2 * cauchy_radius(norm, h, rho),
    ],
)
def test_a_broken_cauchy_step_is_rejected(monkeypatch, mutant):
    monkeypatch.setattr(approximate, "cauchy_radius", mutant)
    problem = spectral("", [-1.0, 0.5, 1.0], [1.0, 5.0, 5.0])
    result = cubic_subsolver(problem.gradient, problem.hvp(), 1.0, gradient_lipschitz=1.0)
    with pytest.raises(AssertionError):
        assert_cauchy(problem, result)


def test_a_recursion_as_printed_is_rejected(monkeypatch):
    """The paper's Finalsolver adds up gradients. It does not meet its tolerance."""
    problem = spectral("", np.linspace(0.1, 1, 8), np.ones(8) / 8, seed=1)

    def as_printed(problem, tolerance):
        step, slope = torch.zeros_like(problem.g), problem.g
        for _ in range(approximate._max_steps(problem)):
            step = step - slope / (20 * problem.lipschitz)
            slope = slope + problem.operator(step) + problem.rho / 2 * step.norm() * step
        return approximate._Candidate(step, problem.operator(step), "as printed")

    monkeypatch.setattr(approximate, "_gradient_descent", as_printed)
    result = cubic_finalsolver(problem.gradient, problem.hvp(), 1.0, epsilon=1e-3, max_steps=2000)
    assert not result.residual <= 1e-3 / 2


def test_a_subsolver_without_perturbation_is_rejected(monkeypatch):
    monkeypatch.setattr(approximate, "random_unit_vector", lambda like, seed: 0 * like)
    with pytest.raises(AssertionError):
        test_subsolver_escapes_a_saddle_it_cannot_see()
