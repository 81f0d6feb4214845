import numpy as np
import pytest
import torch
from hypothesis import given, settings

from sb3_crpn.cubic import secular, solve_dense
from tests.cubic.problems import (
    FAMILY,
    Problem,
    assert_global_minimiser,
    each_problem,
    is_rejected,
    model,
    oracle_decrease,
    problems,
    rotation,
    spectral,
    step_of,
)


def solve(problem, metric=None):
    return solve_dense(problem.gradient, problem.hessian, problem.alpha, metric)


@each_problem
def test_family(problem):
    result = solve(problem)
    assert_global_minimiser(problem, result)
    assert result.products == 0
    assert result.lambda_min == np.linalg.eigvalsh(problem.hessian)[0] or problem.dim > 1


@settings(max_examples=200, deadline=None, derandomize=True)
@given(problems())
def test_generated(problem):
    assert_global_minimiser(problem, solve(problem))


@pytest.mark.parametrize("dim", [1, 2, 5])
@pytest.mark.parametrize("seed", range(10))
def test_decrease_is_that_of_a_bisection_in_100_digits(dim, seed):
    rng = np.random.default_rng(seed)
    eigenvalues = np.sort(rng.standard_normal(dim))
    gamma = rng.standard_normal(dim) * 10.0 ** rng.integers(-9, 2, dim)
    if seed % 2:
        gamma[0] = 0
    alpha = 10.0 ** rng.integers(-4, 7)
    result = solve(spectral("", eigenvalues, gamma, alpha))
    assert result.predicted_decrease == pytest.approx(
        oracle_decrease(eigenvalues, gamma, alpha), rel=1e-13
    )


@pytest.mark.parametrize("k", range(17))
def test_near_hard_decrease(k):
    eigenvalues, gamma = [-1.0, 0.5, 2.0], [10.0**-k, 0.1, 0.2]
    result = solve(spectral("", eigenvalues, gamma))
    expected = oracle_decrease(eigenvalues, gamma, 1.0)
    assert result.predicted_decrease == pytest.approx(expected, rel=1e-13)


def test_one_dimension_against_a_grid():
    problem = spectral("", [-1.5], [0.2], 0.7)
    grid = np.linspace(-10, 10, 200_001)
    values = 0.2 * grid - 0.75 * grid**2 + 0.7 / 6 * np.abs(grid) ** 3
    result = solve(problem)
    assert float(result.step[0]) == pytest.approx(grid[values.argmin()], abs=1e-4)
    assert -result.predicted_decrease <= values.min()


def test_no_random_point_is_better():
    problem = FAMILY[3]
    result = solve(problem)
    radius = float(torch.linalg.vector_norm(result.step))
    for s in np.random.default_rng(0).standard_normal((2000, problem.dim)):
        assert model(problem, s * radius / np.linalg.norm(s)) >= -result.predicted_decrease


def test_zero_gradient_gives_the_leftmost_eigenvector():
    result = solve_dense([0.0, 0.0], [[1.0, 0.0], [0.0, -3.0]], 2.0)
    assert result.step.abs().tolist() == [0.0, pytest.approx(2 * 3 / 2)]


def test_only_the_symmetric_part_counts():
    H, skew = np.diag([-1.0, 2.0, 3.0]), np.triu(np.ones((3, 3)), 1)
    g = np.ones(3)
    expected = solve_dense(g, H, 1.0).step
    torch.testing.assert_close(solve_dense(g, H + skew - skew.T, 1.0).step, expected)


def test_torch_and_numpy_and_float32_are_accepted():
    problem = FAMILY[1]
    from_torch = solve_dense(
        torch.from_numpy(problem.gradient).requires_grad_(), torch.from_numpy(problem.hessian), 1
    )
    torch.testing.assert_close(from_torch.step, solve(problem).step, rtol=0, atol=0)
    single = solve_dense(problem.gradient.astype(np.float32), problem.hessian, 1.0)
    assert single.step.dtype == torch.float64


@pytest.mark.parametrize("index", [1, 2, 3, 4, 7, 11, 13, 17, 18])
@pytest.mark.parametrize("condition", [1.0, 1e3, 1e6])
def test_metric(index, condition):
    problem = FAMILY[index]
    Q = rotation(problem.dim, 50)
    metric = (Q * np.geomspace(1, 1 / condition, problem.dim)) @ Q.T
    metric = (metric + metric.T) / 2
    assert_global_minimiser(problem, solve(problem, metric), metric)


def test_metric_is_a_change_of_variables():
    problem = FAMILY[1]
    L = np.tril(np.random.default_rng(1).standard_normal((12, 12))) + 4 * np.eye(12)
    inverse = np.linalg.inv(L)
    H = inverse @ problem.hessian @ inverse.T
    whitened = Problem("", inverse @ problem.gradient, H, problem.alpha)
    expected, result = solve(whitened), solve(problem, L @ L.T)
    np.testing.assert_allclose(L.T @ result.step.numpy(), expected.step, rtol=1e-10)
    assert result.multiplier == pytest.approx(expected.multiplier)
    assert result.residual <= 1e-12
    assert result.lambda_min == pytest.approx(expected.lambda_min)


def test_rounding_is_reported_not_hidden():
    problem = next(p for p in FAMILY if p.name == "H = I")
    Q = rotation(problem.dim, 50)
    metric = (Q * np.geomspace(1, 1e-12, problem.dim)) @ Q.T
    result = solve(problem, (metric + metric.T) / 2)
    assert not result.certified
    assert result.status.startswith("rounding: residual")
    assert result.residual <= 1e-3 * np.linalg.norm(problem.gradient)


BAD = [
    (dict(gradient=[]), r"gradient has shape \(0,\), must be \(d,\) with d >= 1"),
    (dict(gradient=[[1.0]]), r"gradient has shape \(1, 1\)"),
    (dict(gradient=[np.nan, 0.0]), "gradient has 1 NaN or infinite entries"),
    (dict(hessian=np.eye(3)), r"hessian has shape \(3, 3\), must be \(2, 2\)"),
    (dict(hessian=np.full((2, 2), np.inf)), "hessian has 4 NaN or infinite entries"),
    (
        dict(alpha=0.0),
        r"solve_dense: alpha=0.0 is not allowed, must be a finite number in \(0, inf\)",
    ),
    (dict(alpha=np.inf), "alpha=inf"),
    (dict(alpha=np.nan), "alpha=nan"),
    (dict(metric=np.eye(3)), "metric has shape"),
    (dict(metric=-np.eye(2)), "metric is not positive definite"),
    (dict(metric=np.diag([1.0, 0.0])), "metric is not positive definite"),
]


@pytest.mark.parametrize(("change", "message"), BAD)
def test_bad_input(change, message):
    arguments = dict(gradient=np.ones(2), hessian=np.eye(2), alpha=1.0) | change
    with pytest.raises(ValueError, match=message):
        solve_dense(**arguments)


# Mutants: the judge has to detect broken solvers.


def break_hard_case(monkeypatch):
    monkeypatch.setattr(secular, "_hard_case_length", lambda length, shift: 0.0)


def break_hard_case_length(monkeypatch):
    monkeypatch.setattr(secular, "_hard_case_length", lambda length, shift: shift)


def break_clamp(monkeypatch):
    """Forget that λ ≥ -λ_1."""
    root = secular._secular_root
    monkeypatch.setattr(
        secular, "_secular_root", lambda a, w, shift: (root(a, w, shift)[0] - shift / 2, 0)
    )


def break_iteration(monkeypatch):
    """Take the starting lower bound for the root."""
    monkeypatch.setattr(secular, "_secular_root", lambda *a: (secular._lower_bound(*a), 0))


def break_exponent(monkeypatch):
    """Solve for α instead of ρ = α/2."""
    solve_secular = secular.solve_secular
    monkeypatch.setattr(
        "sb3_crpn.cubic.dense.solve_secular", lambda e, g, alpha: solve_secular(e, g, 2 * alpha)
    )


@pytest.mark.parametrize(
    "mutate",
    [break_hard_case, break_hard_case_length, break_clamp, break_iteration, break_exponent],
)
def test_a_broken_solver_is_rejected(monkeypatch, mutate):
    mutate(monkeypatch)
    with np.errstate(all="ignore"):
        results = [solve_claiming(problem) for problem in FAMILY]
    assert any(is_rejected(p, r) for p, r in zip(FAMILY, results, strict=True))


def solve_claiming(problem):
    """The step with ``certified`` set, so that the judge has to detect the error."""
    return step_of(problem, solve(problem).step)


def test_a_local_minimum_is_rejected():
    # with g = 0.1, H = -1 the global minimiser is s < 0; on s > 0: 0.1 - s + s²/2 = 0
    problem = spectral("", [-1.0], [0.1])
    for s in (1 - np.sqrt(0.8), 1 + np.sqrt(0.8)):
        assert 0.1 - s + s**2 / 2 == pytest.approx(0, abs=1e-15)
        assert is_rejected(problem, step_of(problem, [s]))
    assert_global_minimiser(problem, solve(problem))
    assert float(solve(problem).step[0]) == pytest.approx(-1 - np.sqrt(1.2))


def test_one_triangle_of_an_asymmetric_matrix_is_rejected():
    H = np.array([[1.0, 4.0], [0.0, -1.0]])
    problem = Problem("", np.ones(2), (H + H.T) / 2)
    lower = solve_dense(problem.gradient, np.diag([1.0, -1.0]), 1.0)
    assert is_rejected(problem, step_of(problem, lower.step))
    assert_global_minimiser(problem, solve_dense(problem.gradient, H, 1.0))
