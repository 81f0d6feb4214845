import numpy as np
import pytest
import torch
from torch.func import jacrev

from sb3_crpn.curvature import Causal, Trajectory, estimate_curvature
from sb3_crpn.curvature.derivatives import EpisodeDerivatives
from tests.mdp import differs, random_mdp, random_parameters, tabular_crpn
from tests.policies import frozen_episodes, small_policy

N_REPEATS = 50
N_EPISODES = 160
CRITIC = torch.tensor([[0.5, 1.0, 1.5]])


def repeated_estimates(mdp, **arguments):
    """Gradients [n, d] and Hessians [n, d, d] of independent estimates at a θ ≠ 0."""
    model = tabular_crpn(mdp, n_envs=40, **arguments)  # four episodes each
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
    causal = Causal(0.9)
    estimate = estimate_curvature(policy, actor, batch, causal)
    whole = EpisodeDerivatives(policy, actor, batch, causal)
    v = torch.linspace(-1.0, 1.0, len(actor), dtype=torch.float64)
    torch.testing.assert_close(estimate.gradient, whole.gradient())
    torch.testing.assert_close(estimate.hessian @ v, whole.hessian_product(v))
    torch.testing.assert_close(estimate.fisher @ v, whole.fisher_product(v))
    assert estimate.gradient_batch is batch
    assert estimate.gradient.dtype == torch.float64


def test_gradient_and_hessian_may_come_from_different_episodes(frozen):
    policy, actor, batch = frozen
    few = batch.take(np.array([3, 0]))
    estimate = estimate_curvature(policy, actor, few, Trajectory(), hessian_batch=batch)
    v = torch.ones(len(actor), dtype=torch.float64)
    of_few = EpisodeDerivatives(policy, actor, few, Trajectory())
    of_all = EpisodeDerivatives(policy, actor, batch, Trajectory())
    torch.testing.assert_close(estimate.gradient, of_few.gradient())
    torch.testing.assert_close(estimate.fisher @ v, of_few.fisher_product(v))
    torch.testing.assert_close(estimate.hessian @ v, of_all.hessian_product(v))


def test_graphs_are_shared_and_kept(frozen, monkeypatch):
    policy, actor, batch = frozen
    calls = []
    forward = policy.get_distribution
    monkeypatch.setattr(policy, "get_distribution", lambda obs: calls.append(1) or forward(obs))
    estimate = estimate_curvature(policy, actor, batch, Causal())
    assert len(estimate.hessian.weights) == 2
    estimate.hessian.to_dense()
    assert len(calls) == 2  # one a fold, for g and for H
    estimate.fisher.to_dense()
    assert len(calls) == 4  # the reference of the divergence


def test_fisher_matrix_of_episodes_of_its_own():
    policy, actor = small_policy("gaussian")
    batch = frozen_episodes(policy, lengths=(3, 1, 4, 2, 5))
    few = batch.take(np.array([3, 0, 4]))
    estimate = estimate_curvature(policy, actor, batch, Causal(), fisher_batch=few)
    of_few = estimate_curvature(policy, actor, few, Causal())
    of_all = estimate_curvature(policy, actor, batch, Causal())
    torch.testing.assert_close(estimate.fisher.to_dense(), of_few.fisher.to_dense())
    torch.testing.assert_close(estimate.hessian.to_dense(), of_all.hessian.to_dense())
    torch.testing.assert_close(estimate.gradient, of_all.gradient)


@pytest.mark.parametrize("kind", ["discrete", "gaussian"])
@pytest.mark.parametrize("max_steps", [1, 4, 8, 14])
def test_batches_that_do_not_fit_are_accumulated(kind, max_steps, monkeypatch):
    policy, actor = small_policy(kind)
    batch = frozen_episodes(policy, lengths=(3, 1, 4, 2, 5))
    few = batch.take(np.array([3, 0, 4]))
    whole = estimate_curvature(policy, actor, few, Causal(0.9), hessian_batch=batch)
    passes = []
    forward = policy.get_distribution
    monkeypatch.setattr(
        policy, "get_distribution", lambda obs: passes.append(len(obs)) or forward(obs)
    )
    split = estimate_curvature(
        policy, actor, few, Causal(0.9), hessian_batch=batch, max_steps=max_steps
    )
    v = torch.linspace(-1.0, 1.0, len(actor), dtype=torch.float64)
    exactly = {"rtol": 1e-12, "atol": 1e-14}
    torch.testing.assert_close(split.gradient, whole.gradient, **exactly)
    for name in ("hessian", "fisher"):
        for _ in range(2):
            expected = getattr(whole, name) @ v
            passes.clear()
            products = getattr(split, name) @ v
            torch.testing.assert_close(products, expected, **exactly)
            assert passes  # built anew
            assert max(passes) <= max(max_steps, 5)
    V = torch.stack([v, v.flip(0)], dim=1)
    expected = whole.hessian.group_forms(V)
    passes.clear()
    torch.testing.assert_close(split.hessian.group_forms(V), expected, **exactly)
    assert sum(passes) == batch.n_steps  # one pass over the batch for all columns
    monkeypatch.setattr("sb3_crpn.curvature.operator.MAX_FORM_COLUMNS", 1)
    torch.testing.assert_close(split.hessian.group_forms(V), expected, **exactly)
    assert split.gradient_noise == pytest.approx(whole.gradient_noise, rel=1e-12)


def test_a_batch_that_fits_is_not_split(frozen, monkeypatch):
    policy, actor, batch = frozen
    estimate = estimate_curvature(policy, actor, batch, Causal(), max_steps=15)
    v = torch.ones(len(actor), dtype=torch.float64)
    estimate.hessian @ v
    monkeypatch.setattr(policy, "get_distribution", None)
    estimate.hessian @ v


def test_noise_is_unknown_from_one_episode(frozen):
    policy, actor, batch = frozen
    one = batch.take(np.array([2]))
    estimate = estimate_curvature(policy, actor, one, Causal())
    assert np.isnan(estimate.gradient_noise)
