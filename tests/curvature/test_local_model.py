import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sb3_crpn.cubic import CubicStep, solve_dense
from sb3_crpn.curvature import (
    Causal,
    Constant,
    Euclidean,
    Fisher,
    FullModel,
    JamesStein,
    estimate_curvature,
    subspace_model,
)
from sb3_crpn.curvature.local_model import confirmed_minimum
from tests.policies import frozen_episodes, small_policy

ALPHA = 3.0
METRICS = pytest.mark.parametrize("metric", [Euclidean(), Fisher(0.1)], ids=["euclidean", "fisher"])
LENGTHS = (3, 1, 4, 2, 5, 3)
# the result of a solver with 7 products
STEP = CubicStep(torch.zeros(1), 0.0, 0.0, 7, 0.0, True, "", -2.5)


def estimate_of(lengths=LENGTHS):
    policy, actor = small_policy("discrete")
    batch = frozen_episodes(policy, lengths)
    return estimate_curvature(policy, actor, batch, Causal(0.9))


@pytest.fixture(scope="module")
def estimate():
    return estimate_of()


def matrix_of(metric, estimate):
    identity = torch.eye(estimate.hessian.shape[0], dtype=torch.float64)
    if metric == Euclidean():
        return identity
    return estimate.fisher.to_dense() + metric.damping * identity


def model_value(gradient, hessian, norm, x):
    return gradient @ x + 0.5 * x @ hessian @ x + ALPHA / 6.0 * norm**3


@pytest.mark.parametrize("dim", [None, 5])
@METRICS
def test_the_model_in_coordinates_is_the_model_of_the_step(estimate, metric, dim):
    model = subspace_model(estimate, metric, Constant(0.7), dim)
    M, H = matrix_of(metric, estimate), estimate.hessian.to_dense()
    size = len(estimate.gradient) if dim is None else dim
    assert model.products(STEP) == size
    assert model.shrinkage == 0.7
    assert model.basis.shape == (len(estimate.gradient), size)
    torch.testing.assert_close(model.hessian, model.hessian.T, rtol=0, atol=0)
    identity = torch.eye(size, dtype=torch.float64)
    torch.testing.assert_close(model.basis.T @ M @ model.basis, identity, rtol=0, atol=1e-9)
    for y in torch.randn(3, size, dtype=torch.float64, generator=torch.Generator().manual_seed(0)):
        s = model.to_parameters(y)
        torch.testing.assert_close((s @ M @ s).sqrt(), y.norm())
        torch.testing.assert_close(model.product(y), model.hessian @ y)
        torch.testing.assert_close(
            model_value(model.gradient, model.hessian, y.norm(), y),
            model_value(estimate.gradient, 0.7 * H, (s @ M @ s).sqrt(), s),
        )


@METRICS
def test_the_subspace_is_the_krylov_space_of_the_metric(estimate, metric):
    model = subspace_model(estimate, metric, Constant(), 4)
    operator = estimate.hessian if metric == Euclidean() else estimate.fisher
    generator = operator.to_dense()
    vector = estimate.gradient
    for _ in range(4):
        inside = model.basis @ torch.linalg.lstsq(model.basis, vector).solution
        torch.testing.assert_close(inside, vector, rtol=1e-6, atol=1e-8 * float(vector.norm()))
        vector = generator @ vector
    outside = vector - model.basis @ torch.linalg.lstsq(model.basis, vector).solution
    assert outside.norm() > 1e-6 * vector.norm()


@METRICS
def test_leftmost_eigenvalue_is_that_of_the_unshrunk_hessian(estimate, metric):
    model = subspace_model(estimate, metric, Constant(0.1))
    M, H = matrix_of(metric, estimate), estimate.hessian.to_dense()
    eigenvalues = torch.linalg.eigvals(torch.linalg.solve(M, H)).real
    assert model.lambda_min(STEP) == pytest.approx(eigenvalues.min().item(), abs=1e-9)


@METRICS
def test_the_confirmed_eigenvalue_is_seen_by_the_other_episodes(estimate, metric):
    model = subspace_model(estimate, metric, Constant(0.1))
    W = model.basis.T
    first, second = W @ estimate.hessian.group_forms(torch.eye(len(W.T)).double()) @ W.T
    weights = estimate.hessian.weights
    curvatures = [
        vectors[:, 0] @ judge @ vectors[:, 0]
        for judge, chooser in ((first, second), (second, first))
        for vectors in [torch.linalg.eigh(chooser).eigenvectors]
    ]
    expected = float(weights @ torch.stack(curvatures))
    assert model.confirmed_lambda_min == pytest.approx(expected, abs=1e-9)
    assert model.confirmed_lambda_min > model.lambda_min(STEP)


def test_noise_is_not_confirmed_and_curvature_is():
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(200, 2, 8, 8, dtype=torch.float64, generator=generator)
    noise = noise + noise.transpose(2, 3)
    weights = torch.tensor([0.3, 0.7], dtype=torch.float64)
    curved = torch.diag(torch.tensor([-30.0, *range(7)])).double()
    for matrix, low, high in ((0.0 * curved, -0.5, 0.5), (curved, -30.0, -28.0)):
        found = [confirmed_minimum(matrix + groups, weights) for groups in noise]
        assert low < np.mean(found) < high
    assert max(torch.linalg.eigvalsh(groups[0])[0].item() for groups in noise) < -2.0
    assert math.isnan(confirmed_minimum(curved[None], torch.ones(1).double()))


@METRICS
@pytest.mark.parametrize("dim", [None, 4, 1000])
def test_products_spent_are_those_counted(monkeypatch, metric, dim):
    estimate = estimate_of()
    spent = []
    operator = estimate.hessian
    products, forms = operator._group_products, operator._group_forms
    monkeypatch.setattr(operator, "_group_products", lambda v: spent.append(1) or products(v))
    monkeypatch.setattr(operator, "_group_forms", lambda V: spent.extend(V[0]) or forms(V))
    model = subspace_model(estimate, metric, JamesStein(), dim)
    size = len(estimate.gradient)
    assert len(spent) == model.products(STEP) == model.basis.shape[1]
    # episodes of 18 steps: K(F, g) may end before ℝᵈ does
    assert model.basis.shape[1] == dim if dim == 4 else model.basis.shape[1] <= size


@METRICS
def test_a_vanishing_gradient_still_has_a_model(metric):
    estimate = estimate_of()
    estimate.gradient.zero_()
    model = subspace_model(estimate, metric, Constant(), 3)
    assert model.basis.shape[1] == 3
    assert not model.gradient.any()
    assert model.hessian.any()


def test_the_full_model_knows_the_hessian_by_products(estimate):
    model = FullModel(estimate, 0.5)
    v = torch.ones_like(estimate.gradient)
    assert model.products(STEP) == 7
    assert model.lambda_min(STEP) == -2.5
    assert model.gradient is estimate.gradient
    assert torch.equal(model.to_parameters(v), v)
    torch.testing.assert_close(model.product(v), 0.5 * (estimate.hessian @ v))


@pytest.mark.parametrize("dim", [None, 4])
@METRICS
def test_shrinkage_is_measured_between_two_groups_in_whitened_coordinates(metric, dim):
    policy, actor = small_policy("gaussian")
    batch = frozen_episodes(policy, (1,) * 301)
    batch = replace(batch, cost_advantages=(batch.actions**2).sum(1).double().numpy())
    estimate = estimate_curvature(policy, actor, batch, Causal(0.9))
    model = subspace_model(estimate, metric, JamesStein(), dim)
    identity = torch.eye(len(estimate.gradient), dtype=torch.float64)
    first, second = model.basis.T @ estimate.hessian.group_forms(identity) @ model.basis
    w = estimate.hessian.weights
    assert w.tolist() == [151 / 301, 150 / 301]
    total = w[0] * first + w[1] * second
    noise = w[0] * w[1] * ((first - second) ** 2).sum() / (total**2).sum()
    assert 0.0 < noise < 1.0
    assert model.shrinkage == pytest.approx(1.0 - noise.item(), rel=1e-6)
    torch.testing.assert_close(model.hessian, model.shrinkage * total, rtol=1e-6, atol=1e-9)


@METRICS
def test_one_episode_gives_a_first_order_step(metric):
    estimate = estimate_of(lengths=(5,))
    model = subspace_model(estimate, metric, JamesStein())
    assert model.shrinkage == 0.0
    assert not model.hessian.any()
    assert model.gradient.any()


MIXING = torch.tensor([[2.0, -1.5], [0.3, 0.7]], dtype=torch.float64)


def change_of_outputs(kind, mixing, metric):
    """The change by a cubic step of the outputs of the linear policy z = W (P x) + b, [T, …]."""
    policy, actor = small_policy(kind, net_arch=(), mixing=mixing)
    with torch.no_grad():
        policy.action_net.weight.copy_(policy.action_net.weight @ torch.linalg.inv(mixing))
    batch = frozen_episodes(small_policy(kind, net_arch=())[0], LENGTHS)
    estimate = estimate_curvature(policy, actor, batch, Causal(0.9))
    model = subspace_model(estimate, metric, JamesStein())
    step = model.to_parameters(solve_dense(model.gradient, model.hessian, ALPHA).step)

    def outputs():
        with torch.no_grad():
            distribution = policy.get_distribution(batch.observations).distribution
        if kind == "discrete":
            return distribution.logits
        return torch.cat([distribution.mean, distribution.stddev.log()], dim=1)

    before = outputs()
    actor.assign(actor.vector + step)
    return outputs() - before


@pytest.mark.parametrize("kind", ["discrete", "gaussian"])
def test_only_the_fisher_step_is_free_of_the_parameterisation(kind):
    identity = torch.eye(2, dtype=torch.float64)
    plain, mixed = (change_of_outputs(kind, P, Fisher(1e-9)) for P in (identity, MIXING))
    scale = float(plain.abs().max())
    assert scale > 1e-2
    torch.testing.assert_close(mixed, plain, rtol=0, atol=1e-5 * scale)

    plain, mixed = (change_of_outputs(kind, P, Euclidean()) for P in (identity, MIXING))
    assert (mixed - plain).abs().max() > 1e-2 * plain.abs().max()
