import copy
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_crpn import CRPN
from sb3_crpn.algorithm import algorithm as base
from sb3_crpn.algorithm.critic import fit_critic, fuse
from sb3_crpn.parameters import ActorParameters
from tests.policies import ACTION_SPACES, OBSERVATION_SPACE, frozen_episodes


class LearntFeatures(BaseFeaturesExtractor):
    """A features extractor with parameters, shared between actor and critic by default."""

    def __init__(self, observation_space):
        super().__init__(observation_space, features_dim=4)
        self.linear = nn.Linear(2, 4)

    def forward(self, observations):
        return torch.tanh(self.linear(observations))


@pytest.fixture
def shared():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        policy = ActorCriticPolicy(
            OBSERVATION_SPACE,
            ACTION_SPACES["discrete"],
            lambda _: 1e-2,
            net_arch=[8],
            features_extractor_class=LearntFeatures,
        )
    batch = frozen_episodes(policy, lengths=(5,) * 20)
    returns = batch.observations[:, 0].double().numpy() - 1.0
    log_prob = policy.get_distribution(batch.observations).log_prob(batch.actions)
    return policy, ActorParameters.reachable(policy, log_prob), replace(batch, returns=returns)


def fit(policy, actor, batch, n_epochs=30, seed=0):
    rng = np.random.default_rng(seed)
    n_minibatches = n_epochs * -(-batch.n_steps // 32)
    return fit_critic(policy, actor, batch, n_minibatches=n_minibatches, batch_size=32, rng=rng)


def squared_error(policy, batch):
    with torch.no_grad():
        values = policy.predict_values(batch.observations).flatten().numpy()
    return ((values - batch.returns) ** 2).mean()


def test_the_fit_lowers_the_error_and_leaves_the_actor_bitwise(shared):
    policy, actor, batch = shared
    tensors = actor.snapshot()
    others = [p for p in policy.parameters() if not any(p is q for q in actor.tensors)]
    before = squared_error(policy, batch), [p.detach().clone() for p in others]
    loss = fit(policy, actor, batch)
    after = squared_error(policy, batch)
    assert after < 0.5 * before[0]
    assert after < loss < before[0]
    for tensor, expected in zip(actor.tensors, tensors, strict=True):
        assert torch.equal(tensor, expected)
    assert any(tensor is policy.features_extractor.linear.weight for tensor in actor.tensors)
    assert not any(torch.equal(p, q) for p, q in zip(others, before[1], strict=True))


def test_momentum_of_an_earlier_optimisation_does_not_move_the_actor(shared):
    policy, actor, batch = shared
    policy.optimizer.zero_grad()
    sum((p**2).sum() for p in policy.parameters()).backward()
    policy.optimizer.step()
    tensors = actor.snapshot()
    fit(policy, actor, batch, n_epochs=2)
    assert all(torch.equal(a, b) for a, b in zip(actor.tensors, tensors, strict=True))


def test_minibatches_are_those_of_the_generator(shared):
    policy, actor, batch = shared
    state = {key: value.clone() for key, value in policy.state_dict().items()}
    optimizer = policy.optimizer.state_dict()
    losses = []
    for seed in (1, 1, 2):
        policy.load_state_dict(state)
        policy.optimizer.load_state_dict(optimizer)
        losses.append(fit(policy, actor, batch, n_epochs=2, seed=seed))
    assert losses[0] == losses[1] != losses[2]


def test_no_epochs_are_no_change(shared):
    policy, actor, batch = shared
    before = [p.detach().clone() for p in policy.parameters()]
    assert np.isnan(fit(policy, actor, batch, n_epochs=0))
    for parameter, expected in zip(policy.parameters(), before, strict=True):
        torch.testing.assert_close(parameter.detach(), expected)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e30, 1.5e19, 3e38])
def test_returns_that_are_huge_or_not_finite_leave_finite_parameters(shared, value):
    policy, actor, batch = shared
    returns = batch.returns.copy()
    returns[17] = value
    fit(policy, actor, replace(batch, returns=returns), n_epochs=3)
    assert all(torch.isfinite(p).all() for p in policy.parameters())
    with torch.no_grad():
        values = policy.predict_values(batch.observations)
    assert torch.isfinite(values).all()


class Noise(gym.Env):
    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.normal(size=2).astype(np.float32), {}

    def step(self, action):
        observation = self.np_random.normal(size=2).astype(np.float32)
        return observation, float(action), self.np_random.random() < 0.2, False, {}


def test_the_update_fits_the_critic_around_a_shared_extractor(monkeypatch):
    model = CRPN(
        "MlpPolicy",
        Noise(),
        n_episodes=4,
        policy_kwargs={"features_extractor_class": LearntFeatures},
        seed=0,
        device="cpu",
    )
    shared = model.policy.features_extractor.linear.weight
    assert any(tensor is shared for tensor in model.actor.tensors)
    states = []
    take, fit_values = base.take_step, model._fit_critic
    monkeypatch.setattr(
        base, "take_step", lambda *a: (take(*a), states.append(model.actor.vector))[0]
    )
    monkeypatch.setattr(
        model, "_fit_critic", lambda *a: (states.append("critic"), fit_values(*a))[1]
    )
    start, value = model.actor.vector, model.policy.value_net.weight.detach().clone()
    model.learn(1)
    assert states[1] == "critic"
    assert torch.equal(model.actor.vector, states[0])
    assert not torch.equal(model.actor.vector, start)
    assert not torch.equal(model.policy.value_net.weight, value)


def test_earlier_rollouts_share_in_the_minibatches_of_the_fresh_one(monkeypatch):
    passes = []
    monkeypatch.setattr(
        base, "fit_critic", lambda *a, **options: passes.append((a[2].n_steps, options)) or 0.0
    )
    CRPN("MlpPolicy", Noise(), n_episodes=20, n_critic_updates=3, seed=0, device="cpu").learn(300)
    sizes = [n_steps for n_steps, _ in passes]
    assert sizes == sorted(sizes)
    assert sizes[-1] > sizes[0]
    assert {options["n_minibatches"] for _, options in passes} == {3}


def test_fused_steps_are_adams(shared):
    policy, actor, batch = shared
    start = copy.deepcopy(policy.state_dict())
    results = []
    for fused in (False, True):
        policy.load_state_dict(start)
        policy.optimizer = torch.optim.Adam(policy.parameters(), lr=1e-2)
        if fused:
            fuse(policy.optimizer)
        assert bool(policy.optimizer.param_groups[0]["fused"]) is fused
        fit(policy, actor, batch, n_epochs=3)
        results.append(copy.deepcopy(policy.state_dict()))
    torch.testing.assert_close(*results, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("optimizer", "kwargs"),
    [("Adam", {"fused": False}), ("Adam", {"foreach": True}), ("RMSprop", {}), ("SGD", {})],
)
def test_an_optimiser_with_a_way_of_its_own_keeps_it(optimizer, kwargs):
    parameters = [nn.Parameter(torch.zeros(2))]
    ours = getattr(torch.optim, optimizer)(parameters, lr=0.1, **kwargs)
    expected = {k: v for k, v in ours.param_groups[0].items() if k != "params"}
    fuse(ours)
    assert {k: v for k, v in ours.param_groups[0].items() if k != "params"} == expected


def test_models_use_fused_adam_also_when_loaded(tmp_path):
    model = CRPN("MlpPolicy", "CartPole-v1", n_steps=64, device="cpu", seed=0).learn(64)
    model.save(tmp_path / "model")
    loaded = CRPN.load(tmp_path / "model", device="cpu")
    for each in (model, loaded):
        assert each.policy.optimizer.param_groups[0]["fused"]
