from dataclasses import replace

import numpy as np
import pytest
import torch

from sb3_crpn.curvature import Causal
from sb3_crpn.curvature.derivatives import EpisodeDerivatives
from sb3_crpn.episodes import Replay
from sb3_crpn.episodes import batch as episode_batch
from sb3_crpn.episodes.advantages import cost_advantages, generalized_advantages
from sb3_crpn.episodes.buffer import CHUNK
from sb3_crpn.episodes.replay import MAX_RATIO
from tests.policies import frozen_episodes, small_policy

GAMMA, GAE_LAMBDA = 0.9, 0.8
RAW = {"baseline": True, "normalize_advantage": False, "discount_visitation": False}


def evaluated(policy, batch):
    with torch.no_grad():
        values, log_probs, _ = policy.evaluate_actions(batch.observations, batch.actions)
    return values.flatten().double().numpy(), log_probs.double().numpy()


def terminal_values(policy, batch):
    with torch.no_grad():
        values = policy.predict_values(batch.next_observations).flatten().double().numpy()
    assert 0 < batch.bootstrapped.sum() < batch.n_episodes
    return np.where(batch.bootstrapped, values, 0.0)


def rollout(policy, **arguments):
    """Episodes with the log-probabilities of the behaviour policy ``policy``."""
    batch = frozen_episodes(policy, **arguments)
    return replace(batch, log_probs=evaluated(policy, batch)[1])


def kept(*batches, size=3):
    earlier = Replay(size, GAMMA, GAE_LAMBDA)
    for batch in batches:
        earlier.append(batch)
    return earlier


def perturb(policy, scale):
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter += scale * torch.randn_like(parameter)


@pytest.mark.parametrize("baseline", [True, False])
@pytest.mark.parametrize("normalize_advantage", [True, False])
@pytest.mark.parametrize("discount_visitation", [True, False])
def test_rollout_of_the_present_policy_has_the_weights_of_a_fresh_one(
    baseline, normalize_advantage, discount_visitation
):
    policy, _ = small_policy("discrete")
    batch = rollout(policy)
    values = evaluated(policy, batch)[0]
    advantages = generalized_advantages(
        batch.rewards, values, terminal_values(policy, batch), batch.lengths, GAMMA, GAE_LAMBDA
    )
    options = {
        "normalize_advantage": normalize_advantage,
        "discount_visitation": discount_visitation,
    }
    (again,) = kept(batch).reweighted(policy, baseline=baseline, **options)
    np.testing.assert_allclose(
        again.cost_advantages,
        cost_advantages(
            advantages if baseline else advantages + values,
            batch.lengths,
            batch.times,
            gamma=GAMMA,
            **options,
        ),
        rtol=1e-5,
        atol=1e-6,
    )
    np.testing.assert_allclose(again.returns, values + advantages, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(again.values, values)


@pytest.mark.parametrize(("kind", "scale"), [("discrete", 0.5), ("gaussian", 0.2)])
def test_weights_follow_the_formula_after_the_policy_has_moved(kind, scale):
    policy, _ = small_policy(kind)
    batch = rollout(policy, lengths=(3, 1, 4, 2, 30))
    with torch.random.fork_rng():
        torch.manual_seed(1)
        perturb(policy, scale)
    values, log_probs = evaluated(policy, batch)
    ratios = np.exp(log_probs - batch.log_probs)
    assert ratios.min() < 1.0 < MAX_RATIO < ratios.max()
    (again,) = kept(batch).reweighted(policy, **RAW)
    traces = np.minimum(1.0, ratios)
    advantages = generalized_advantages(
        batch.rewards,
        values,
        terminal_values(policy, batch),
        batch.lengths,
        GAMMA,
        GAE_LAMBDA,
        traces,
    )
    np.testing.assert_allclose(again.cost_advantages, -np.minimum(MAX_RATIO, ratios) * advantages)
    np.testing.assert_allclose(again.returns, values + traces * advantages)


def test_reused_bandit_gives_the_exact_gradient_and_curvature_of_the_present_policy():
    """Episodes of one step, every action in proportion to the old policy: ρ < ρ̄ is unbiased."""
    policy, actor = small_policy("discrete", net_arch=())
    batch = frozen_episodes(policy, lengths=(1,) * 1200)
    observation = batch.observations[:1]
    rewards = np.array([1.0, -2.0, 0.5])
    with torch.no_grad():
        old = policy.get_distribution(observation).distribution.probs[0].double().numpy()
    counts = np.round(1200 * old).astype(int)
    counts[0] += 1200 - counts.sum()
    actions = np.repeat(np.arange(3), counts)
    present = old * [1.2, 0.9, 1.0]
    present /= present.sum()
    old = counts / 1200  # the frequencies are the probabilities
    with torch.no_grad():
        policy.action_net.weight[:] = 0.0
        policy.action_net.bias[:] = torch.tensor(np.log(present))
        policy.value_net.weight[:] = 0.0
        policy.value_net.bias[:] = 0.0
    batch = replace(
        batch,
        observations=torch.zeros_like(batch.observations),
        actions=torch.as_tensor(actions),
        rewards=rewards[actions],
        log_probs=np.log(old[actions]),
        bootstrapped=np.zeros(1200, dtype=bool),
    )
    (again,) = kept(batch).reweighted(policy, **RAW)
    group = EpisodeDerivatives(policy, actor, again, Causal(1.0))
    bias = actor.vector.clone().requires_grad_()

    def cost(theta):
        logits = theta[-3:]  # observations are zero: the bias alone counts
        return -(torch.softmax(logits, 0) @ torch.as_tensor(rewards))

    exact = torch.autograd.functional.hessian(cost, bias)
    (gradient,) = torch.autograd.grad(cost(bias), bias)
    torch.testing.assert_close(group.gradient(), gradient, rtol=1e-5, atol=1e-6)
    vector = torch.randn(len(actor), dtype=torch.float64)
    torch.testing.assert_close(group.hessian_product(vector), exact @ vector, rtol=1e-5, atol=1e-6)


def test_the_oldest_is_forgotten_first():
    policy, _ = small_policy("discrete")
    batches = [rollout(policy, seed=seed) for seed in range(4)]
    earlier = kept(*batches, size=2)
    found = earlier.reweighted(policy, **RAW)
    assert [b.rewards[0] for b in found] == [b.rewards[0] for b in batches[2:]]
    earlier.clear()
    assert earlier.reweighted(policy, **RAW) == []
    assert kept(*batches, size=0).reweighted(policy, **RAW) == []


@pytest.mark.parametrize("change", [0.1, 0.4, -100.0, 100.0])
def test_a_rollout_is_forgotten_for_good_once_its_effective_size_is_less_than_half(change):
    policy, _ = small_policy("gaussian")
    batch = rollout(policy, lengths=(50,) * 40)
    earlier = kept(batch)
    with torch.no_grad():
        policy.log_std += change
    with np.errstate(over="ignore", invalid="ignore"):
        ratios = np.exp(evaluated(policy, batch)[1] - batch.log_probs)
        effective = ratios.sum() ** 2 / (ratios**2).sum() / batch.n_steps  # nan for 0 / 0
    alike = bool(effective > Replay.min_effective_size)
    assert alike == (change == 0.1)
    assert bool(earlier.reweighted(policy, **RAW)) == alike
    with torch.no_grad():
        policy.log_std -= change
    assert bool(earlier.reweighted(policy, **RAW)) == alike


def test_long_rollouts_are_evaluated_in_pieces():
    policy, _ = small_policy("discrete")
    batch = rollout(policy, lengths=(CHUNK, 100, 50))
    (again,) = kept(batch).reweighted(policy, **RAW)
    np.testing.assert_allclose(again.values, evaluated(policy, batch)[0], rtol=1e-5, atol=1e-6)


def test_no_episodes_on_this_rank(monkeypatch):
    of_another = torch.tensor([10.0, 10.0, 10.0], dtype=torch.float64)
    monkeypatch.setattr(episode_batch, "all_sum", lambda tensor: tensor + of_another)
    policy, _ = small_policy("discrete")
    batch = rollout(policy).take(np.zeros(0, dtype=int))
    (again,) = kept(batch).reweighted(policy, **RAW)
    assert again.n_steps == again.n_episodes == 0
