"""The paper's lemmas, as inequalities between exactly known numbers."""

import itertools

import numpy as np
import pytest
import torch

from benchmarks.exact import coordination_mdp
from sb3_crpn.cubic import solve_dense

MDP = coordination_mdp()
# sup ‖∇³J‖ of this MDP (tests/benchmarks/experiments/test_experiments.py)
L_H = 2.65


def norm(matrix):
    return float(torch.linalg.matrix_norm(matrix, 2))


def points(seed):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(2, MDP.n_parameters, dtype=torch.float64, generator=generator)


@pytest.mark.parametrize("seed", range(10))
def test_taylor_remainders_are_bounded_by_the_lipschitz_constant(seed):
    """Remark 4."""
    one, two = points(seed)
    step, hessian = one - two, MDP.hessian(two)
    length = float(step.norm())
    gradient = MDP.gradient(one) - MDP.gradient(two) - hessian @ step
    assert 0 < float(gradient.norm()) <= L_H / 2 * length**2
    model = MDP.gradient(two) @ step + step @ hessian @ step / 2
    assert 0 < abs(float(MDP.cost(one) - MDP.cost(two) - model)) <= L_H / 6 * length**3


def step_with_errors(seed, size):
    """A cubic step from estimates with known errors: θ_{k-1}, θ_k, r, ‖g - ∇J‖ and ‖H - ∇²J‖."""
    theta, noise = points(seed)
    generator = torch.Generator().manual_seed(seed)
    error = torch.randn(len(theta), len(theta), dtype=torch.float64, generator=generator)
    error, noise = size * (error + error.T), size * noise
    step = solve_dense(MDP.gradient(theta) + noise, MDP.hessian(theta) + error, 3 * L_H).step
    return theta, theta + step, float(step.norm()), float(noise.norm()), norm(error)


@pytest.mark.parametrize("size", [0.0, 0.01, 0.3])
@pytest.mark.parametrize("seed", range(5))
def test_a_short_step_leads_to_a_stationary_point(seed, size):
    """Lemmas 7 and 10, for one step: α = 3 L_H, so that L_H + α = 4 L_H and α + 2 L_H = 5 L_H."""
    _, after, r, e_1, e_2 = step_with_errors(seed, size)
    assert float(MDP.gradient(after).norm()) <= 4 * L_H * r**2 + e_1 + e_2**2 / (8 * L_H)
    least = float(torch.linalg.eigvalsh(MDP.hessian(after))[0])
    assert -least <= 5 / 2 * L_H * r + e_2


@pytest.mark.parametrize("size", [0.0, 0.01, 0.3])
@pytest.mark.parametrize("seed", range(5))
def test_a_long_step_pays(seed, size):
    """Lemmas 8 and 11, for one step: (α/36) r³ ≤ J - J⁺ + 4 e_1^{3/2}/√(3α) + (9√2/α)² e_2³."""
    before, after, r, e_1, e_2 = step_with_errors(seed, size)
    alpha, gain = 3 * L_H, float(MDP.cost(before) - MDP.cost(after))
    errors = 4 * e_1**1.5 / np.sqrt(3 * alpha) + 162 / alpha**2 * e_2**3
    assert alpha / 36 * r**3 <= gain + errors


@pytest.mark.parametrize("seed", range(20))
def test_an_order_of_matrices_bounds_the_largest_eigenvalue(seed):
    """Lemmas 6 and 12: A ⪯ B + cI, with the smallest such c, implies c ≥ λ_max(A) - ‖B‖."""
    A, B = np.random.default_rng(seed).normal(size=(2, 4, 4))
    A, B = A + A.T, B + B.T
    least = np.linalg.eigvalsh(A - B)[-1]
    assert least >= np.linalg.eigvalsh(A)[-1] - np.linalg.norm(B, 2)


def atoms(seed):
    """A random matrix with three equally likely values, one of them an outlier."""
    values = np.random.default_rng(seed).normal(size=(3, 3, 3))
    values[0] *= 4.0
    return values


def fourth_moment(values):
    return np.mean(np.linalg.norm(values, axis=(1, 2)) ** 4)


@pytest.mark.parametrize("seed", range(20))
def test_centring_costs_at_most_five_in_the_fourth_moment(seed):
    """Lemma 13, in the Frobenius norm of its proof."""
    values = atoms(seed)
    assert fourth_moment(values - values.mean(0)) <= 5 * fourth_moment(values)


@pytest.mark.parametrize("n", [1, 2, 4])
@pytest.mark.parametrize("seed", range(5))
def test_rosenthals_inequality(seed, n):
    """Lemma 14, for independent terms of one distribution, over all outcomes."""
    values = atoms(seed)
    values -= values.mean(0)
    sums = np.array([sum(outcome) for outcome in itertools.product(values, repeat=n)])
    assert fourth_moment(sums) <= 3 * n**2 * fourth_moment(values)
