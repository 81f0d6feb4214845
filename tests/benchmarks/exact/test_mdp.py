import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.exact import coordination_mdp, expected_causal_hessian, random_mdp

MDPS = [
    coordination_mdp(gamma=0.9, noise=0.5),
    random_mdp(0, n_states=3, horizon=3),
    random_mdp(1, n_states=3, n_actions=3, horizon=3),
    random_mdp(2, n_states=4, n_observations=2, horizon=3),  # aliased
    random_mdp(3, n_states=4, n_observations=1, horizon=2, gamma=1.0),
    random_mdp(4, n_states=3, horizon=3, max_stop=0.5),
]
mdps = pytest.mark.parametrize("mdp", MDPS)


def parameters(mdp, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(mdp.n_parameters, dtype=torch.float64, generator=generator)


def policy(mdp, theta):
    """π(a|o), [O, A], from its definition."""
    weight, bias = np.split(theta.numpy(), [-mdp.n_actions])
    logits = np.exp(weight.reshape(mdp.n_actions, -1).T + bias)
    return logits / logits.sum(1, keepdims=True)


def enumerated_cost(mdp, theta):
    """-Σ_τ P(τ) Σ_h γ^h r_h P(not stopped before h | τ) over every sequence of H cells."""
    stop = np.zeros(mdp.reward.shape) if mdp.stop is None else mdp.stop.numpy()
    initial, transition, reward = (x.numpy() for x in (mdp.initial, mdp.transition, mdp.reward))
    pi, seen, total = policy(mdp, theta), mdp.observation.numpy(), 0.0
    cells = list(itertools.product(range(len(initial)), range(mdp.n_actions)))
    for episode in itertools.product(cells, repeat=mdp.horizon):
        probability, value, into, alive = 1.0, 0.0, initial, 1.0
        for h, (state, action) in enumerate(episode):
            probability *= into[state] * pi[seen[state], action]
            value += mdp.gamma**h * alive * reward[state, action]
            alive *= 1.0 - stop[state, action]
            into = transition[state, action]
        total -= probability * value
    return total


def central_differences(function, theta, step=1e-5):
    rows = [
        function(theta + e) - function(theta - e) for e in step * torch.eye(len(theta)).double()
    ]
    return torch.stack([torch.as_tensor(row) for row in rows]) / (2 * step)


@mdps
def test_the_cost_is_that_of_all_trajectories(mdp):
    theta = parameters(mdp)
    assert mdp.cost(theta).item() == pytest.approx(enumerated_cost(mdp, theta), abs=1e-12)


@mdps
def test_the_derivatives_are_those_of_the_enumerated_cost(mdp):
    theta = parameters(mdp, 1)
    gradient = central_differences(lambda at: enumerated_cost(mdp, at), theta)
    torch.testing.assert_close(mdp.gradient(theta), gradient, rtol=0, atol=1e-8)
    hessian = central_differences(mdp.gradient, theta)
    torch.testing.assert_close(mdp.hessian(theta), hessian, rtol=0, atol=1e-8)


@mdps
def test_the_surrogate_has_the_gradient_of_the_cost_and_no_curvature_across_time(mdp):
    theta = parameters(mdp)
    gradient = central_differences(lambda at: mdp.surrogate(at, theta, mdp.gamma), theta)
    torch.testing.assert_close(gradient, mdp.gradient(theta), rtol=0, atol=1e-9)
    expected = expected_causal_hessian(mdp, theta, 0.0)
    hessian = torch.autograd.functional.hessian(
        lambda at: mdp.surrogate(at, theta, mdp.gamma), theta
    )
    torch.testing.assert_close(hessian, expected, rtol=0, atol=1e-12)


def test_the_mean_length_of_episodes():
    theta = parameters(MDPS[-1])
    assert random_mdp(0, horizon=7).mean_length(parameters(random_mdp(0))) == pytest.approx(7)
    mdp = replace(MDPS[-1], stop=torch.full((3, 2), 0.5, dtype=torch.float64))
    assert mdp.mean_length(theta) == pytest.approx(1 + 0.5 + 0.25)


@mdps
def test_values_are_what_is_left_to_gain(mdp):
    theta = parameters(mdp)
    values = mdp.values(theta)
    assert values.shape == (mdp.horizon + 1, len(mdp.initial))
    assert not values[-1].any()
    pi = mdp.probabilities(theta)
    torch.testing.assert_close(values[-2], (pi * mdp.reward).sum(1))
    assert -(mdp.initial @ values[0]) == mdp.cost(theta)


@pytest.mark.parametrize("gamma", [1.0, 0.7])
@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_the_uniform_policy_of_the_coordination_mdp_is_a_strict_saddle(gamma, noise):
    mdp = coordination_mdp(gamma, noise)
    uniform = torch.zeros(mdp.n_parameters, dtype=torch.float64)
    assert mdp.cost(uniform) == pytest.approx(0.0, abs=1e-15)
    torch.testing.assert_close(mdp.gradient(uniform), uniform, rtol=0, atol=1e-15)
    eigenvalues = torch.linalg.eigvalsh(mdp.hessian(uniform))
    expected = torch.tensor([-1.5, 0, 0, 0, 0, 0.5], dtype=torch.float64) * gamma
    torch.testing.assert_close(eigenvalues, expected, rtol=0, atol=1e-14)


def test_the_cost_of_the_coordination_mdp_is_the_product_of_two_tangents():
    mdp = coordination_mdp(0.9, noise=2.0)
    theta = parameters(mdp)
    first, second, bias = theta[[2, 3, 5]] - theta[[0, 1, 4]]
    expected = -0.9 * torch.tanh((first + bias) / 2) * torch.tanh((second + bias) / 2)
    torch.testing.assert_close(mdp.cost(theta), expected, rtol=0, atol=1e-14)


def test_second_order_stationarity():
    mdp = coordination_mdp()
    uniform = torch.zeros(6, dtype=torch.float64)
    good = torch.tensor([-3.0, -3.0, 3.0, 3.0, 0.0, 0.0], dtype=torch.float64)
    assert not mdp.is_sosp(uniform, 0.1, rho=1.0)  # λ_min = -1.5 < -√0.1
    assert mdp.is_sosp(uniform, 0.1, rho=23.0)  # -√2.3 < -1.5
    assert mdp.is_sosp(good, 0.1, rho=1.0)
    assert not mdp.is_sosp(good, 1e-4, rho=1.0)
    assert not mdp.is_sosp(0.2 * good, 0.1, rho=1e9)  # the gradient
