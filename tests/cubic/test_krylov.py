import numpy as np
import pytest
import torch
from hypothesis import given, settings

from sb3_crpn.cubic import krylov, lanczos, secular, solve_dense, solve_krylov
from sb3_crpn.cubic.lanczos import KrylovSpace
from sb3_crpn.cubic.step import CountedOperator
from tests.cubic.problems import (
    FAMILY,
    SPECTRA,
    Counter,
    assert_global_minimiser,
    each_problem,
    is_rejected,
    large,
    problems,
    spectral,
    step_of,
)


def solve(problem, **options):
    return solve_krylov(problem.gradient, problem.hvp(), problem.alpha, **options)


@each_problem
def test_family(problem):
    hvp = problem.hvp()
    result = solve_krylov(problem.gradient, hvp, problem.alpha)
    assert_global_minimiser(problem, result)
    assert result.products == len(hvp.calls) <= problem.dim + 1


@settings(max_examples=200, deadline=None, derandomize=True)
@given(problems())
def test_generated(problem):
    assert_global_minimiser(problem, solve(problem))


@pytest.mark.parametrize("alpha", [1e-4, 1.0, 1e6])
@pytest.mark.parametrize("hide", [0, 1, 5])
@pytest.mark.parametrize("seed", range(3))
def test_large_problems_agree_with_dense(alpha, hide, seed):
    problem = large(seed=seed, hide=hide, alpha=alpha)
    result = solve(problem)
    expected = solve_dense(problem.gradient, problem.hessian, alpha)
    assert_global_minimiser(problem, result)
    assert result.predicted_decrease == pytest.approx(expected.predicted_decrease, rel=1e-8)
    assert result.multiplier == pytest.approx(expected.multiplier, rel=1e-8)


@pytest.mark.parametrize("name", SPECTRA)
@pytest.mark.parametrize("seed", range(4))
def test_the_random_start_finds_what_the_gradient_cannot_see(name, seed):
    problem = large(eigenvalues=SPECTRA[name], hide=1, seed=seed, size=1e-4)
    result = solve(problem, seed=seed)
    assert_global_minimiser(problem, result)
    assert result.lambda_min == pytest.approx(SPECTRA[name][0], rel=1e-6)
    if name != "clusters":
        component = abs(float(result.step @ torch.from_numpy(hidden_eigenvector(problem))))
        assert component > 1e-3 * float(result.step.norm())


def hidden_eigenvector(problem):
    return np.linalg.eigh(problem.hessian)[1][:, 0].copy()


def test_zero_gradient_finds_the_leftmost_eigenvector():
    problem = large(eigenvalues=SPECTRA["decaying"])
    result = solve_krylov(np.zeros(problem.dim), problem.hvp(), 2.0)
    torch.testing.assert_close(
        result.step.abs(), torch.from_numpy(0.5 * abs(hidden_eigenvector(problem)))
    )
    assert result.certified


def test_easy_problems_are_cheap():
    # cubic term dominates: a few products for g, about ten for the random start, one to confirm
    assert solve(large(alpha=1e6)).products <= 20
    # two distinct eigenvalues: two-dimensional Krylov spaces
    assert solve(large(eigenvalues=np.repeat([-1.0, 2.0], 150))).products <= 2 + 2 + 1
    # H = 0: one product each shows that g and the random start are eigenvectors
    assert solve(spectral("", np.zeros(50), np.ones(50))).products == 3


@pytest.mark.parametrize("max_products", [2, 3, 10, 40])
def test_running_out_of_products(max_products):
    problem = large(hide=1)
    hvp = problem.hvp()
    result = solve_krylov(problem.gradient, hvp, 1.0, max_products=max_products)
    assert result.products == len(hvp.calls) == max_products
    assert not result.certified
    assert "max_products" in result.status
    residual = problem.hessian @ result.step.numpy() + result.multiplier * result.step.numpy()
    assert result.residual == pytest.approx(np.linalg.norm(residual + problem.gradient))
    assert 0 < result.predicted_decrease <= solve(problem).predicted_decrease


def test_more_products_never_hurt():
    decreases = [solve(large(), max_products=n).predicted_decrease for n in range(2, 60, 4)]
    assert np.all(np.diff(decreases) >= -1e-14 * decreases[-1])


def test_inexact_products_are_not_certified():
    problem = large()
    single = torch.from_numpy(problem.hessian.astype(np.float32))
    result = solve_krylov(problem.gradient, lambda v: single @ v.float(), 1.0, tol=1e-10)
    assert not result.certified
    assert "products are inexact" in result.status
    result = solve_krylov(problem.gradient, lambda v: single @ v.float(), 1.0, tol=1e-5)
    assert result.certified


def test_tolerance_buys_products():
    loose, tight = (solve(large(alpha=10.0), tol=tol) for tol in (1e-2, 1e-12))
    assert loose.products < tight.products
    assert tight.residual < 1e-11


def test_the_seed_decides_and_the_global_generator_is_untouched():
    problem = large(hide=1)
    state, numpy_state = torch.random.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    first, again, other = (solve(problem, seed=seed) for seed in (0, 0, 1))
    assert torch.equal(first.step, again.step)
    assert not torch.equal(first.step, other.step)
    assert torch.equal(state, torch.random.get_rng_state())
    assert np.array_equal(numpy_state, np.random.get_state()[1])  # noqa: NPY002


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(gradient=np.array([1.0, np.inf])), "gradient has 1 NaN"),
        (dict(alpha=-1.0), "solve_krylov: alpha=-1.0"),
        (dict(tol=0.0), "tol=0.0"),
        (dict(max_products=1), "max_products=1 is not allowed, must be an integer >= 2"),
        (dict(max_products=2.5), "max_products=2.5"),
        (dict(hvp=lambda v: v[:1]), r"hvp returned shape \(1,\)"),
        (dict(hvp=lambda v: v * np.nan), "the product of solve_krylov: hvp has 2 NaN"),
    ],
)
def test_bad_input(change, message):
    arguments = dict(gradient=np.ones(2), hvp=lambda v: v, alpha=1.0) | change
    with pytest.raises(ValueError, match=message):
        solve_krylov(**arguments)


# krylov_basis


def test_another_alpha_costs_no_product():
    problem = large(seed=1)
    hvp = problem.hvp()
    g = torch.from_numpy(problem.gradient)
    space = KrylovSpace(CountedOperator("hvp", hvp), g)
    chain = space.start_chain(g)
    for _ in range(problem.dim):
        space.extend(chain)
    assert len(hvp.calls) == problem.dim
    for alpha in (1e-2, 1.0, 1e2):
        point = krylov._minimise(space, float(g.norm()), alpha, 1e-8)
        expected = solve_dense(g, problem.hessian, alpha)
        s = space.basis.T @ torch.from_numpy(point.coordinates)
        torch.testing.assert_close(s, expected.step)
    assert len(hvp.calls) == problem.dim


def test_residual_is_known_without_a_product():
    problem = large(hide=1)
    H, g = torch.from_numpy(problem.hessian), torch.from_numpy(problem.gradient)
    space = KrylovSpace(CountedOperator("hvp", Counter(H)), g)
    chains = [space.start_chain(g)]
    for turn in range(20):
        if turn == 8:
            chains.append(space.start_chain(torch.ones_like(g)))
        space.extend(chains[turn % len(chains)])
    point = krylov._minimise(space, float(g.norm()), 1.0, 1e-8)
    s = space.basis.T @ torch.from_numpy(point.coordinates)
    assert point.residual == pytest.approx(float((H @ s + point.multiplier * s + g).norm()))


# Mutants: the judge has to detect broken solvers.


def break_random_start(monkeypatch):
    monkeypatch.setattr(krylov, "_leftmost_is_resolved", lambda *_: True)


def break_hard_case(monkeypatch):
    monkeypatch.setattr(secular, "_hard_case_length", lambda length, shift: 0.0)


def break_stopping_rule(monkeypatch):
    monkeypatch.setattr(krylov, "residual_tolerance", lambda *_: 0.1)


def break_orthogonality(monkeypatch):
    monkeypatch.setattr(lanczos.KrylovSpace, "_orthogonalise", lambda self, v: 1.0 * v)


def break_multiplier(monkeypatch):
    solve_secular = secular.solve_secular
    monkeypatch.setattr(
        krylov, "solve_secular", lambda e, g, alpha: solve_secular(e - e.min(), g, alpha)
    )


@pytest.mark.parametrize(
    "mutate",
    [
        break_random_start,
        break_hard_case,
        break_stopping_rule,
        break_orthogonality,
        break_multiplier,
    ],
)
def test_a_broken_solver_is_rejected(monkeypatch, mutate):
    family = [problem for problem in FAMILY if problem.dim == 12][:12]
    mutate(monkeypatch)
    claims = [step_of(p, solve(p, max_products=50).step) for p in family]
    assert any(is_rejected(p, claim) for p, claim in zip(family, claims, strict=True))


def test_a_solver_without_random_start_misses_the_hidden_direction(monkeypatch):
    # diagonal, so that rounding errors have no component along the direction
    problem = spectral("", SPECTRA["outlier"], np.r_[0, np.ones(299)])
    assert_global_minimiser(problem, solve(problem))
    break_random_start(monkeypatch)
    assert is_rejected(problem, solve(problem))
