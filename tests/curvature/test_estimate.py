import numpy as np
import pytest
import torch
from torch.func import jacrev

from sb3_crpn.curvature import GroupedOperator, PairWeights, estimate_curvature
from sb3_crpn.curvature.derivatives import EpisodeDerivatives
from sb3_crpn.curvature.estimate import relative_noise
from tests.mdp import differs, random_mdp, random_parameters, tabular_crpn
from tests.policies import frozen_episodes, small_policy

N_REPEATS = 50
N_EPISODES = 160
CRITIC = torch.tensor([[0.5, 1.0, 1.5]])


def repeated_estimates(mdp, **arguments):
    """Gradients [n, d] and Hessians [n, d, d] of independent estimates at a θ ≠ 0."""
    model = tabular_crpn(mdp, n_envs=8, **arguments)
    theta = random_parameters(mdp)
    model.actor.assign(theta)
    with torch.no_grad():
        model.policy.value_net.weight.copy_(CRITIC)
    estimates = [model.estimate_curvature(N_EPISODES) for _ in range(N_REPEATS)]
    gradients = torch.stack([estimate.gradient for estimate in estimates])
    return theta, gradients, torch.stack([e.hessian.to_dense() for e in estimates])


def hessian(function):
    """∇² in reverse mode; the forward mode of torch.func.hessian warns."""
    return jacrev(jacrev(function))


def upper(matrices):
    rows, columns = torch.triu_indices(*matrices.shape[-2:])
    return matrices[..., rows, columns]


@pytest.mark.parametrize("fixed_length", [True, False], ids=["fixed", "random"])
@pytest.mark.parametrize("baseline", [False, True], ids=["plain", "baseline"])
@pytest.mark.parametrize("estimator", ["trajectory", "causal"])
def test_estimates_are_unbiased(estimator, baseline, fixed_length):
    mdp = random_mdp(3, fixed_length=fixed_length)
    theta, gradients, hessians = repeated_estimates(
        mdp, hessian_estimator=estimator, hessian_lambda=1.0, baseline=baseline
    )
    assert not differs(gradients, jacrev(mdp.cost)(theta))
    assert not differs(upper(hessians), upper(hessian(mdp.cost)(theta)))

    undiscounted = jacrev(mdp.surrogate)(theta, theta, 1.0)
    no_cross_terms = hessian(mdp.surrogate)(theta, theta, mdp.gamma)
    assert differs(gradients, undiscounted)
    assert differs(upper(hessians), upper(no_cross_terms))


def test_without_cross_terms_the_estimate_is_the_curvature_of_the_surrogate():
    mdp = random_mdp(3)
    theta, gradients, hessians = repeated_estimates(
        mdp, hessian_estimator="causal", hessian_lambda=0.0, discount_visitation=False
    )
    assert not differs(gradients, jacrev(mdp.surrogate)(theta, theta, 1.0))
    assert not differs(upper(hessians), upper(hessian(mdp.surrogate)(theta, theta, 1.0)))
    assert differs(gradients, jacrev(mdp.cost)(theta))
    assert differs(upper(hessians), upper(hessian(mdp.cost)(theta)))


def test_the_exact_derivatives_are_consistent():
    mdp = random_mdp(3)
    theta = random_parameters(mdp)
    gradient = jacrev(mdp.cost)(theta)
    torch.testing.assert_close(jacrev(mdp.surrogate)(theta, theta, mdp.gamma), gradient)


@pytest.fixture
def frozen():
    policy, actor = small_policy("discrete")
    return policy, actor, frozen_episodes(policy, lengths=(3, 1, 4, 2, 5))


def test_groups_of_episodes_add_up_to_the_whole_batch(frozen):
    policy, actor, batch = frozen
    pair_weights = PairWeights("causal", 0.9)
    estimate = estimate_curvature(policy, actor, batch, batch, pair_weights)
    whole = EpisodeDerivatives(policy, actor, batch, pair_weights)
    v = torch.linspace(-1.0, 1.0, len(actor), dtype=torch.float64)
    torch.testing.assert_close(estimate.gradient, whole.gradient())
    torch.testing.assert_close(estimate.hessian @ v, whole.hessian_product(v))
    torch.testing.assert_close(estimate.fisher @ v, whole.fisher_product(v))
    assert estimate.gradient_batch is batch
    assert estimate.gradient.dtype == torch.float64


def test_gradient_and_hessian_may_come_from_different_episodes(frozen):
    policy, actor, batch = frozen
    pair_weights = PairWeights("trajectory")
    few = batch.take(np.array([3, 0]))
    estimate = estimate_curvature(policy, actor, few, batch, pair_weights)
    v = torch.ones(len(actor), dtype=torch.float64)
    of_few = EpisodeDerivatives(policy, actor, few, pair_weights)
    of_all = EpisodeDerivatives(policy, actor, batch, pair_weights)
    torch.testing.assert_close(estimate.gradient, of_few.gradient())
    torch.testing.assert_close(estimate.fisher @ v, of_few.fisher_product(v))
    torch.testing.assert_close(estimate.hessian @ v, of_all.hessian_product(v))


def test_graphs_are_shared_and_kept(frozen, monkeypatch):
    policy, actor, batch = frozen
    calls = []
    forward = policy.get_distribution
    monkeypatch.setattr(policy, "get_distribution", lambda obs: calls.append(1) or forward(obs))
    estimate = estimate_curvature(policy, actor, batch, batch, PairWeights("causal"))
    n_groups = len(estimate.hessian.weights)
    estimate.hessian.to_dense()
    assert len(calls) == n_groups


def test_fisher_matrix_of_episodes_of_its_own():
    policy, actor = small_policy("gaussian")
    batch = frozen_episodes(policy, lengths=(3, 1, 4, 2, 5))
    few = batch.take(np.array([3, 0, 4]))
    weights = PairWeights("causal")
    estimate = estimate_curvature(policy, actor, batch, batch, weights, fisher_batch=few)
    of_few = estimate_curvature(policy, actor, few, few, weights)
    of_all = estimate_curvature(policy, actor, batch, batch, weights)
    torch.testing.assert_close(estimate.fisher.to_dense(), of_few.fisher.to_dense())
    torch.testing.assert_close(estimate.hessian.to_dense(), of_all.hessian.to_dense())
    torch.testing.assert_close(estimate.gradient, of_all.gradient)


@pytest.mark.parametrize("kind", ["discrete", "gaussian"])
@pytest.mark.parametrize("max_steps", [1, 4, 8, 14])
def test_batches_that_do_not_fit_are_accumulated(kind, max_steps, monkeypatch):
    policy, actor = small_policy(kind)
    batch = frozen_episodes(policy, lengths=(3, 1, 4, 2, 5))
    few = batch.take(np.array([3, 0, 4]))
    whole = estimate_curvature(policy, actor, few, batch, PairWeights("causal", 0.9))
    passes = []
    forward = policy.get_distribution
    monkeypatch.setattr(
        policy, "get_distribution", lambda obs: passes.append(len(obs)) or forward(obs)
    )
    split = estimate_curvature(policy, actor, few, batch, PairWeights("causal", 0.9), max_steps)
    v = torch.linspace(-1.0, 1.0, len(actor), dtype=torch.float64)
    exactly = {"rtol": 1e-12, "atol": 1e-14}
    torch.testing.assert_close(split.gradient, whole.gradient, **exactly)
    for name in ("hessian", "fisher"):
        for _ in range(2):
            expected = getattr(whole, name).group_products(v)
            passes.clear()
            products = getattr(split, name).group_products(v)
            torch.testing.assert_close(products, expected, **exactly)
            assert passes  # built anew
            assert max(passes) <= max(max_steps, 5)
    V = torch.stack([v, v.flip(0)], dim=1)
    expected = whole.hessian.group_forms(V)
    passes.clear()
    torch.testing.assert_close(split.hessian.group_forms(V), expected, **exactly)
    assert sum(passes) == batch.n_steps  # one pass over the batch for all columns
    monkeypatch.setattr("sb3_crpn.curvature.estimate.MAX_FORM_COLUMNS", 1)
    torch.testing.assert_close(split.hessian.group_forms(V), expected, **exactly)
    assert split.gradient_noise == pytest.approx(whole.gradient_noise, rel=1e-12)


def test_a_batch_that_fits_is_not_split(frozen, monkeypatch):
    policy, actor, batch = frozen
    estimate = estimate_curvature(policy, actor, batch, batch, PairWeights("causal"), 15)
    v = torch.ones(len(actor), dtype=torch.float64)
    estimate.hessian @ v
    monkeypatch.setattr(policy, "get_distribution", None)
    estimate.hessian @ v


def test_the_operator_is_linear_and_symmetric(frozen):
    policy, actor, batch = frozen
    estimate = estimate_curvature(policy, actor, batch, batch, PairWeights("causal", 0.5))
    generator = torch.Generator().manual_seed(0)
    V = torch.randn(len(actor), 3, dtype=torch.float64, generator=generator)
    for operator in (estimate.hessian, estimate.fisher):
        dense = operator.to_dense()
        assert operator.shape == dense.shape == (len(actor), len(actor))
        assert torch.equal(dense, dense.T)
        torch.testing.assert_close(operator @ V, dense @ V, rtol=1e-9, atol=1e-12)
        torch.testing.assert_close(operator @ V[:, 0], dense @ V[:, 0], rtol=1e-9, atol=1e-12)
        combined = operator @ (2.0 * V[:, 0] - V[:, 1])
        torch.testing.assert_close(
            combined, 2.0 * (operator @ V[:, 0]) - operator @ V[:, 1], rtol=1e-9, atol=1e-12
        )
        assert (operator @ V.float()).dtype == torch.float64


@pytest.mark.parametrize("shape", [(), (3,), (3, 4), (4, 1, 1)])
def test_operands_of_the_wrong_shape_are_refused(shape):
    operator = GroupedOperator(4, lambda v: v[None], torch.ones(1))
    with pytest.raises(ValueError, match=r"operand has shape .* must be \(4,\) or \(4, n\)"):
        operator @ torch.ones(shape)


def test_groups_are_weighted_by_their_sizes():
    sizes = torch.tensor([3.0, 1.0], dtype=torch.float64)
    operator = GroupedOperator(2, lambda v: torch.stack([v, 5.0 * v]), sizes)
    assert operator.weights.tolist() == [0.75, 0.25]
    assert (operator @ torch.ones(2)).tolist() == [2.0, 2.0]


def test_relative_noise_estimates_the_variance_of_the_mean():
    generator = torch.Generator().manual_seed(0)
    weights = torch.tensor([0.5, 0.3, 0.2], dtype=torch.float64)
    truth = torch.tensor([3.0, -1.0], dtype=torch.float64)
    ratios, errors = [], []
    for _ in range(4000):
        noise = torch.randn(3, 2, dtype=torch.float64, generator=generator)
        groups = truth + noise / weights.sqrt()[:, None] / 10.0
        mean = weights @ groups
        ratios.append(relative_noise(groups, weights) * (mean**2).sum())
        errors.append(((mean - truth) ** 2).sum())
    differences = torch.stack(ratios) - torch.stack(errors)
    assert not differs(differences, 0.0)
    assert differs(2.0 * torch.stack(ratios) - torch.stack(errors), 0.0)


def test_noise_of_two_groups_is_their_disagreement():
    x = torch.tensor([[1.0, 2.0], [0.0, 3.0]], dtype=torch.float64)
    weights = torch.tensor([0.75, 0.25], dtype=torch.float64)
    expected = 0.75 * 0.25 * 2.0 / (0.75**2 + 2.25**2)
    assert relative_noise(x, weights) == pytest.approx(expected)


def test_noise_is_unknown_from_one_episode(frozen):
    policy, actor, batch = frozen
    one = batch.take(np.array([2]))
    estimate = estimate_curvature(policy, actor, one, one, PairWeights("causal"))
    assert np.isnan(estimate.gradient_noise)
    assert np.isnan(relative_noise(torch.zeros(2, 3), torch.full((2,), 0.5)))
