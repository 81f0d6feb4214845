from dataclasses import replace

import numpy as np
import pytest
import torch

from sb3_crpn.parameters import ActorParameters
from sb3_crpn.theory import ScoreBounds, gaussian_linear, softmax_linear
from tests.policies import frozen_episodes, log_hessians, scores, small_policy

FEATURE_NORM = 1.5
STD = 0.4
# SB3 rounds observations to float32
ROUNDING = 1.0 + 1e-6


def linear_policy(kind):
    """A policy with ``net_arch=[]`` whose only parameters are W and b."""
    policy, _ = small_policy(kind, net_arch=())
    if kind == "gaussian":
        policy.log_std.requires_grad_(False).fill_(np.log(STD))
    distribution = policy.get_distribution(torch.zeros(1, 2))
    log_prob = distribution.log_prob(distribution.mode().detach())
    return policy, ActorParameters.reachable(policy, log_prob)


def bounded_episodes(policy, seed, n_steps=12):
    """Actions of the policy at features with ‖φ‖ ≤ FEATURE_NORM, half of them on the bound."""
    batch = frozen_episodes(policy, (n_steps,), seed)
    observations = batch.observations.double()
    norms = observations.norm(dim=1, keepdim=True)
    norms[::2] += 1.0
    observations = FEATURE_NORM * observations / norms
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(seed)
        actions = policy.get_distribution(observations).sample()
    return replace(batch, observations=observations, actions=actions)


def one_step(policy, observation, action):
    batch = frozen_episodes(policy, (1,))
    return replace(
        batch,
        observations=torch.tensor([observation], dtype=torch.float64),
        actions=torch.tensor([action], dtype=batch.actions.dtype),
    )


def lipschitz_quotient(policy, actor, batch, direction, length):
    """The largest ‖∇²log π(θ + hv) - ∇²log π(θ - hv)‖ / 2h over the batch, for a unit vector v."""
    origin = actor.vector
    actor.assign(origin + length * direction)
    ahead = log_hessians(policy, actor, batch)
    actor.assign(origin - length * direction)
    change = ahead - log_hessians(policy, actor, batch)
    actor.assign(origin)
    return float(torch.linalg.matrix_norm(change, 2).max()) / (2.0 * length)


def bounds_of(kind, n_actions=1, failure_probability=1e-3):
    if kind == "discrete":
        return softmax_linear(FEATURE_NORM)
    return gaussian_linear(
        FEATURE_NORM, STD, 2, n_actions=n_actions, failure_probability=failure_probability
    )


@pytest.mark.parametrize("scale", [0.1, 1.0, 4.0])
@pytest.mark.parametrize("kind", ["discrete", "gaussian"])
def test_sampled_policies_stay_within_the_bounds(kind, scale):
    policy, actor = linear_policy(kind)
    bounds = bounds_of(kind, n_actions=3 * 12)
    generator = torch.Generator().manual_seed(0)
    for seed in range(3):
        draws = torch.randn(2, len(actor), dtype=torch.float64, generator=generator)
        actor.assign(scale * draws[0])
        batch = bounded_episodes(policy, seed)
        assert float(scores(policy, actor, batch).norm(dim=1).max()) <= bounds.G * ROUNDING
        curvature = torch.linalg.matrix_norm(log_hessians(policy, actor, batch), 2)
        assert float(curvature.max()) <= bounds.L_1 * ROUNDING
        direction = draws[1] / draws[1].norm()
        for length in (1e-3, 1.0):
            quotient = lipschitz_quotient(policy, actor, batch, direction, length)
            assert quotient <= bounds.L_2 * ROUNDING + 1e-9


def softmax_at(logits):
    """A softmax policy with these logits at φ = (FEATURE_NORM, 0), by W alone."""
    policy, actor = linear_policy("discrete")
    actor.assign(torch.zeros(len(actor)))
    with torch.no_grad():
        policy.action_net.weight[:, 0] = torch.tensor(logits) / FEATURE_NORM
    return policy, actor, one_step(policy, [FEATURE_NORM, 0.0], 0)


def test_the_softmax_bounds_are_attained():
    bounds = softmax_linear(FEATURE_NORM)
    improbable = softmax_at([-20.0, 20.0, 0.0])
    assert float(scores(*improbable).norm()) >= 0.999 * bounds.G
    even = softmax_at([0.0, 0.0, -30.0])
    assert float(torch.linalg.matrix_norm(log_hessians(*even)[0], 2)) >= 0.999 * bounds.L_1
    share = (1.0 - 1.0 / np.sqrt(3.0)) / 2.0
    policy, actor, step = softmax_at([np.log(share), np.log(1.0 - share), -30.0])
    features = torch.tensor([FEATURE_NORM, 0.0, 1.0], dtype=torch.float64)
    along = torch.outer(torch.tensor([1.0, -1.0, 0.0], dtype=torch.float64), features)
    along = torch.cat([along[:, :2].flatten(), along[:, 2]])
    quotient = lipschitz_quotient(policy, actor, step, along / along.norm(), 1e-4)
    assert quotient >= 0.999 * bounds.L_2


def test_the_gaussian_curvature_is_attained_and_constant():
    policy, actor = linear_policy("gaussian")
    bounds = bounds_of("gaussian")
    step = one_step(policy, [0.0, FEATURE_NORM], [0.3, -0.2])
    curvature = torch.linalg.matrix_norm(log_hessians(policy, actor, step)[0], 2)
    assert float(curvature) == pytest.approx(bounds.L_1)
    direction = torch.ones(len(actor), dtype=torch.float64) / len(actor) ** 0.5
    assert lipschitz_quotient(policy, actor, step, direction, 1.0) <= 1e-9


@pytest.mark.parametrize("failure_probability", [0.5, 0.05])
def test_the_gaussian_score_passes_its_bound_no_more_often_than_stated(failure_probability):
    policy, _ = linear_policy("gaussian")
    observations = torch.tensor([[FEATURE_NORM, 0.0]], dtype=torch.float64).repeat(20_000, 1)
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(0)
        distribution = policy.get_distribution(observations).distribution
        noise = (distribution.sample() - distribution.mean) / STD
    norms = noise.norm(dim=1) * np.hypot(FEATURE_NORM, 1.0) / STD
    bound = bounds_of("gaussian", failure_probability=failure_probability).G
    assert 0.0 < float((norms > bound).double().mean()) <= failure_probability
    everyone = bounds_of("gaussian", n_actions=20_000, failure_probability=failure_probability).G
    assert bound < float(norms.max()) <= everyone


def test_without_a_bias_there_is_no_constant_feature():
    expected = {"G": np.sqrt(2.0), "L_1": 0.5, "L_2": np.sqrt(6.0) / 9.0}
    assert vars(softmax_linear(1.0, bias=False)) == pytest.approx(expected)
    assert softmax_linear(1.0) == softmax_linear(np.sqrt(2.0), bias=False)
    few = {"n_actions": 1, "failure_probability": 1.0}
    assert gaussian_linear(3.0, 2.0, 4, bias=False, **few) == ScoreBounds(3.0, 2.25, 0.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: softmax_linear(0.0), r"feature_norm=0.0 .* \(0, inf\)"),
        (lambda: softmax_linear(float("nan")), "feature_norm=nan"),
        (lambda: ScoreBounds(0.0, 1.0, 1.0), "G=0.0"),
        (lambda: ScoreBounds(1.0, -1.0, 1.0), r"L_1=-1.0 .* \[0, inf\)"),
        (lambda: ScoreBounds(1.0, 1.0, float("inf")), "L_2=inf"),
        (lambda: gaussian_linear(1, 0.0, 1, n_actions=1, failure_probability=0.1), "std=0.0"),
        (lambda: gaussian_linear(1, 1, 0, n_actions=1, failure_probability=0.1), "action_dim=0"),
        (lambda: gaussian_linear(1, 1, 1, n_actions=1.5, failure_probability=0.1), "n_actions=1.5"),
        (
            lambda: gaussian_linear(1, 1, 1, n_actions=1, failure_probability=1.1),
            r"failure_probability=1.1 .* \(0, 1\]",
        ),
    ],
)
def test_mistakes_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
