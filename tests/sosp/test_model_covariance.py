from itertools import product

import numpy as np
import pytest
import torch

from benchmarks.exact import coordination_mdp
from sb3_crpn.episodes.batch import episode_time
from sb3_crpn.sosp import certify_sosp
from sb3_crpn.sosp import model_covariance as module
from sb3_crpn.sosp.model_covariance import model_covariance
from tests.policies import flat_gradient, frozen_episodes, small_policy
from tests.sosp.problems import tabular

GAMMA = 0.9
N_BLOCKS = 2
ACTIONS = {
    "discrete": torch.arange(3),
    "multidiscrete": torch.tensor(list(product(range(2), range(3)))),
    "multibinary": torch.tensor(list(product((0.0, 1.0), repeat=2))),
}


def setting(kind):
    policy, actor = small_policy(kind)
    return policy, actor, frozen_episodes(policy)


def dense(policy, actor, batch):
    operator = model_covariance(policy, actor, batch, N_BLOCKS, GAMMA)
    return torch.stack([operator(v) for v in torch.eye(len(actor), dtype=torch.float64)])


def distribution_at(policy, batch, i):
    return policy.get_distribution(batch.observations[i : i + 1])


def expectation(weighted_scores):
    return sum(w * torch.outer(s, s) for w, s in weighted_scores)


def nodes(kind, distribution, log_prob_gradient):
    """All actions with probabilities, or the nodes of an exact quadrature for a Gaussian."""
    if kind != "gaussian":
        for action in ACTIONS[kind]:
            log_prob = distribution.log_prob(action[None])
            yield log_prob.exp().item(), log_prob_gradient(log_prob)
        return
    points, weights = np.polynomial.hermite_e.hermegauss(3)  # exact to degree 5, scores² have 4
    normal = distribution.distribution
    for i, j in product(range(3), repeat=2):
        z = torch.tensor([[points[i], points[j]]])
        action = (normal.mean + normal.stddev * z).detach()
        weight = weights[i] * weights[j] / (2.0 * np.pi)
        yield weight, log_prob_gradient(distribution.log_prob(action))


@pytest.mark.parametrize("kind", ["gaussian", *ACTIONS])
def test_it_averages_the_actions_at_their_probabilities(kind, monkeypatch):
    monkeypatch.setattr(module, "MAX_RARE_COUNT", 0.0)
    policy, actor, batch = setting(kind)
    total = 0.0
    for i, weight in enumerate(batch.cost_advantages):
        distribution = distribution_at(policy, batch, i)
        scores = nodes(kind, distribution, lambda x: flat_gradient(x.sum(), actor))
        total = total + weight**2 * expectation(scores)
    expected = total * N_BLOCKS / batch.n_episodes**2
    torch.testing.assert_close(dense(policy, actor, batch), expected)


def test_the_rarest_actions_count_with_the_cost_to_go(monkeypatch):
    policy, actor, batch = setting("discrete")
    probabilities = torch.cat(
        [distribution_at(policy, batch, i).distribution.probs for i in range(batch.n_steps)]
    ).detach()
    ascending = probabilities.flatten().sort().values
    least = ascending[:4]
    monkeypatch.setattr(module, "MAX_RARE_COUNT", 0.0)
    common = dense(policy, actor, batch)
    monkeypatch.setattr(module, "MAX_RARE_COUNT", float(least.sum()) + 1e-6)
    costs = GAMMA ** episode_time(batch.lengths) * batch.returns
    total = 0.0
    for i, a in (probabilities <= least[-1]).nonzero():
        score = flat_gradient(distribution_at(policy, batch, i).log_prob(a[None]).sum(), actor)
        scale = abs(costs[i]) + abs(batch.cost_advantages[i] + costs[i])
        total = total + probabilities[i, a] * scale**2 * torch.outer(score, score)
    rare = dense(policy, actor, batch) - common
    torch.testing.assert_close(rare, total * N_BLOCKS / batch.n_episodes**2)


@pytest.mark.parametrize("baseline", [0.0, 0.97])
def test_a_nearly_deterministic_policy_is_not_certified_by_episodes_that_agree(baseline):
    """Half of such samples contain no action with gradient and curvature."""
    mdp = coordination_mdp()
    theta = torch.tensor([2.5, -2.5, -2.5, 2.5, 0.0, 0.0], dtype=torch.float64)
    slope = mdp.gradient(theta).norm().item()
    bend = torch.linalg.eigvalsh(mdp.hessian(theta))[0].item()
    model = tabular(mdp, theta)
    torch.nn.init.zeros_(model.policy.value_net.weight)
    torch.nn.init.constant_(model.policy.value_net.bias, -baseline)
    agreed = 0
    for seed in range(6):
        report = certify_sosp(model, 50, epsilon=0.5 * slope, rho=1.0, seed=seed)
        agreed += report.gradient_norm.estimate < 0.9 * slope
        assert report.gradient_norm.lower <= slope <= report.gradient_norm.upper
        assert report.lambda_min.lower <= bend <= report.lambda_min.upper
    assert agreed >= 1
