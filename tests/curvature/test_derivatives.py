import numpy as np
import pytest
import torch
from stable_baselines3.common.distributions import kl_divergence

from sb3_crpn.curvature.derivatives import EpisodeDerivatives, policy_distribution
from tests.policies import (
    ACTION_SPACES,
    ESTIMATORS,
    central_jacobian,
    dense_hessian,
    episode_slices,
    estimator_of,
    flat_gradient,
    frozen_episodes,
    log_probabilities,
    scores,
    small_policy,
)

KINDS = ["discrete", "gaussian"]


def group_of(kind, estimator="causal", decay=0.9, **options):
    policy, actor = small_policy(kind, **options)
    batch = frozen_episodes(small_policy(kind)[0])
    group = EpisodeDerivatives(policy, actor, batch, estimator_of(estimator, decay))
    return policy, actor, batch, group


def columns(product, size):
    return torch.stack([product(e) for e in torch.eye(size, dtype=torch.float64)], dim=1)


@pytest.mark.parametrize("kind", ACTION_SPACES)
def test_gradient_is_the_weighted_sum_of_scores(kind):
    policy, actor, batch, group = group_of(kind)
    expected = (
        torch.from_numpy(batch.cost_advantages) @ scores(policy, actor, batch) / batch.n_episodes
    )
    torch.testing.assert_close(group.gradient(), expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("case", ESTIMATORS)
def test_products_are_those_of_the_dense_hessian(kind, case):
    policy, actor, batch, group = group_of(kind, *case)
    product = columns(group.hessian_product, len(actor))
    torch.testing.assert_close(product, product.T, rtol=0, atol=1e-12)
    expected = dense_hessian(policy, actor, batch, *case)
    torch.testing.assert_close(product, expected, rtol=1e-10, atol=1e-12)
    V = torch.randn(len(actor), 3, dtype=torch.float64)
    form = group.quadratic_form(V)
    torch.testing.assert_close(form, V.T @ expected @ V, rtol=1e-10, atol=1e-11)


@pytest.mark.parametrize("kind", KINDS)
def test_trajectory_products_differentiate_the_reweighted_gradient(kind):
    policy, actor, batch, group = group_of(kind, "trajectory")
    reference = log_probabilities(policy, batch).detach()

    def gradient():
        log_prob = log_probabilities(policy, batch)
        log_ratio = (log_prob - reference).detach()
        weights = torch.from_numpy(batch.cost_advantages.copy())
        for steps in episode_slices(batch):
            weights[steps] *= log_ratio[steps].sum().exp()
        return flat_gradient((weights * log_prob).sum() / batch.n_episodes, actor)

    jacobian = central_jacobian(gradient, actor)
    product = columns(group.hessian_product, len(actor))
    torch.testing.assert_close(product, 0.5 * (jacobian + jacobian.T), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("decay", [0.0, 1.0])
def test_causal_products_differentiate_the_gradient_of_the_surrogate(kind, decay):
    policy, actor, batch, group = group_of(kind, "causal", decay)
    reference = log_probabilities(policy, batch).detach()

    def objective():
        log_ratio = log_probabilities(policy, batch) - reference
        total = 0.0
        for steps in episode_slices(batch):
            A = torch.from_numpy(batch.cost_advantages[steps])
            if decay == 0.0:
                total = total + A @ log_ratio[steps].exp()
            else:
                cost = A - torch.cat([A[1:], A.new_zeros(1)])
                total = total + cost @ log_ratio[steps].cumsum(0).exp()
        return total / batch.n_episodes

    jacobian = central_jacobian(lambda: flat_gradient(objective(), actor), actor)
    product = columns(group.hessian_product, len(actor))
    torch.testing.assert_close(product, jacobian, rtol=1e-6, atol=1e-7)


def test_one_forward_pass_serves_all_products_at_two_backward_passes_each(monkeypatch):
    policy, actor, _, group = group_of("discrete")
    calls = {"forward": 0, "backward": 0}

    def counted(name, function):
        def count(*args, **kwargs):
            calls[name] += 1
            return function(*args, **kwargs)

        return count

    monkeypatch.setattr(policy, "get_distribution", counted("forward", policy.get_distribution))
    monkeypatch.setattr(torch.autograd, "grad", counted("backward", torch.autograd.grad))
    group.gradient()
    assert calls == {"forward": 1, "backward": 1}
    for _ in range(5):
        group.hessian_product(torch.randn(len(actor), dtype=torch.float64))
    assert calls == {"forward": 1, "backward": 1 + 2 * 5}
    for _ in range(5):
        group.fisher_product(torch.randn(len(actor), dtype=torch.float64))
    assert calls == {"forward": 2, "backward": 1 + 2 * 5 + 1 + 5}
    calls["backward"] = 0
    group.quadratic_form(torch.randn(len(actor), 5, dtype=torch.float64))
    assert calls == {"forward": 2, "backward": 5}


@pytest.mark.parametrize("kind", KINDS)
def test_single_precision_agrees(kind):
    _, actor, _, exact = group_of(kind)
    *_, single = group_of(kind, dtype=torch.float32)
    v = torch.linspace(-1.0, 1.0, len(actor), dtype=torch.float64)
    for name in ("hessian_product", "fisher_product"):
        product = getattr(single, name)(v)
        assert product.dtype == torch.float64
        torch.testing.assert_close(product, getattr(exact, name)(v), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(single.gradient(), exact.gradient(), rtol=1e-3, atol=1e-5)


def n_components(kind):
    return 1 if kind == "discrete" else int(np.prod(ACTION_SPACES[kind].shape))


def all_actions(kind):
    space = ACTION_SPACES[kind]
    if kind == "discrete":
        return torch.arange(space.n)
    sizes = [2] * space.n if kind == "multibinary" else space.nvec.tolist()
    return torch.cartesian_prod(*(torch.arange(n) for n in sizes)).float()


@pytest.mark.parametrize("kind", ["discrete", "multidiscrete", "multibinary"])
def test_fisher_is_the_expected_outer_product_of_scores(kind):
    policy, actor, batch, group = group_of(kind)
    expected = torch.zeros(len(actor), len(actor), dtype=torch.float64)
    for observation in batch.observations:
        distribution = policy.get_distribution(observation[None])
        for action in all_actions(kind):
            log_prob = distribution.log_prob(action[None]).squeeze()
            score = flat_gradient(log_prob, actor)
            expected += log_prob.exp().detach() * torch.outer(score, score) / batch.n_steps
    expected /= n_components(kind)
    fisher = columns(group.fisher_product, len(actor))
    torch.testing.assert_close(fisher, expected, rtol=1e-9, atol=1e-7)


def test_fisher_of_a_gaussian_is_that_of_its_mean_and_scale():
    policy, actor, batch, group = group_of("gaussian")
    expected = torch.zeros(len(actor), len(actor), dtype=torch.float64)
    for observation in batch.observations:
        normal = policy.get_distribution(observation[None]).distribution
        natural = torch.cat([normal.mean[0], normal.stddev[0].log()])
        J = torch.stack([flat_gradient(z, actor) for z in natural])
        F = torch.cat([normal.stddev[0] ** -2, torch.full((2,), 2.0)]).detach()
        expected += J.T @ (F[:, None] * J) / batch.n_steps / n_components("gaussian")
    fisher = columns(group.fisher_product, len(actor))
    torch.testing.assert_close(fisher, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", ACTION_SPACES)
def test_fisher_predicts_the_mean_divergence(kind):
    policy, actor, batch, group = group_of(kind)
    step = 1e-3 * torch.randn(
        len(actor), dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    predicted = 0.5 * step @ group.fisher_product(step)
    with torch.no_grad():
        before = policy_distribution(policy, batch)
        actor.assign(actor.vector + step)
        divergence = kl_divergence(before, policy_distribution(policy, batch))
    mean = divergence.sum() / batch.n_steps / n_components(kind)
    torch.testing.assert_close(predicted, mean, rtol=1e-2, atol=0)


def test_the_distribution_is_not_overwritten_by_the_next():
    policy, _, batch, _ = group_of("gaussian")
    distribution = policy_distribution(policy, batch)
    mean = distribution.distribution.mean.clone()
    policy.get_distribution(batch.observations + 1.0)
    assert torch.equal(distribution.distribution.mean, mean)
