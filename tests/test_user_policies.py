"""Policies that users replace, freeze, unfreeze, copy or interrupt."""

import copy
from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import kl_divergence
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn
from torch.nn import functional

from sb3_crpn import CRPN
from sb3_crpn.algorithm.evaluation import CandidateEvaluator
from sb3_crpn.curvature import Causal
from sb3_crpn.curvature.derivatives import EpisodeDerivatives
from sb3_crpn.policy import find_actor
from sb3_crpn.sosp import certify_sosp
from tests.envs import Drift, Sampler
from tests.policies import frozen_episodes, scores
from tests.training import TrainLog, all_finite, both, make, same, several, tensors


class Trunk(BaseFeaturesExtractor):
    """Two layers that actor and critic share."""

    def __init__(self, observation_space):
        super().__init__(observation_space, features_dim=6)
        size = spaces.flatdim(observation_space)
        self.first, self.second = nn.Linear(size, 6), nn.Linear(6, 6)

    def forward(self, observations):
        return torch.tanh(self.second(torch.tanh(self.first(observations))))


def shared(algorithm, **arguments):
    kwargs = {"features_extractor_class": Trunk}
    return make(algorithm, net_arch=(), policy_kwargs=kwargs, **arguments)


def moved(module, earlier):
    return not torch.equal(module.weight, earlier)


@both
def test_a_replaced_policy_is_the_one_that_trains(algorithm):
    """The usual warm start from behaviour cloning."""
    model, log = make(algorithm), TrainLog()
    model.policy = make(algorithm, seed=7).policy
    theta, value = model.actor.vector, model.policy.value_net.weight.clone()
    model.learn(60, log)
    assert not torch.equal(model.actor.vector, theta)
    assert moved(model.policy.value_net, value)
    assert min(log["kl_divergence"]) > 1e-6
    assert min(log["gradient_norm"]) > 1e-6


@both
def test_replaced_heads_train_also_after_loading(algorithm, tmp_path):
    model = make(algorithm, several(2)).learn(30)
    for name in ("action_net", "value_net"):
        old = getattr(model.policy, name)
        setattr(model.policy, name, nn.Linear(old.in_features, old.out_features))
    for survivor in (model, None):
        if survivor is None:
            model.save(tmp_path / "model")
            survivor = algorithm.load(tmp_path / "model", env=several(2), device="cpu")
        heads = survivor.policy.action_net, survivor.policy.value_net
        before = [head.weight.clone() for head in heads]
        log = TrainLog()
        survivor.learn(60, log)
        assert all(map(moved, heads, before))
        assert min(log["kl_divergence"]) > 1e-6


def divergence(old, new, observations):
    """The mean of KL(old ‖ new), by SB3's own."""
    with torch.no_grad():
        pair = [policy.get_distribution(observations) for policy in (old, new)]
    return kl_divergence(*pair).mean().item()


@both
def test_unfrozen_layers_move_within_the_bound(algorithm):
    """Unfrozen layers belong to the actor. The critic's fit does not change them."""
    model = shared(algorithm, n_critic_updates=50, learning_rate=0.05)
    layer = model.policy.features_extractor.first
    layer.requires_grad_(False)
    frozen = layer.weight.clone()
    model.learn(1)
    assert torch.equal(layer.weight, frozen)
    layer.requires_grad_(True)
    before = copy.deepcopy(model.policy)
    model.learn(1, reset_num_timesteps=False)
    observations = torch.from_numpy(model.rollout_buffer.observations.reshape(-1, 2))
    assert moved(layer, frozen)
    assert 0.0 < divergence(before, model.policy, observations) <= 1.001 * model.target_kl
    assert any(layer.weight is tensor for tensor in model.actor.tensors)


@both
@pytest.mark.parametrize("when", ["constructed", "learnt", "loaded"])
def test_frozen_layers_stay_bit_for_bit(algorithm, when, tmp_path):
    model = shared(algorithm)
    if when != "constructed":
        model.learn(30)
    if when == "loaded":
        model.save(tmp_path / "model")
        model = algorithm.load(tmp_path / "model", env=Drift(), device="cpu")
    layer, other = model.policy.features_extractor.first, model.policy.features_extractor.second
    layer.requires_grad_(False)
    frozen, trainable = layer.weight.clone(), other.weight.clone()
    model.learn(60, reset_num_timesteps=False)
    assert torch.equal(layer.weight, frozen)
    assert moved(other, trainable)
    assert len(model.actor) == sum(p.numel() for p in model.actor.tensors)
    assert not any(layer.weight is tensor for tensor in model.actor.tensors)


class Masked(ActorCriticPolicy):
    """The observation is the mask of valid actions. No action is valid at zeros."""

    def get_distribution(self, observations):
        distribution = super().get_distribution(observations)
        logits = distribution.distribution.logits
        mask = observations[:, : logits.shape[1]] > 0.5
        return distribution.proba_distribution(logits.masked_fill(~mask, -torch.inf))


class Valid(Drift):
    """Both of the actions are valid."""

    def _observe(self):
        return np.ones(2, np.float32)


@both
def test_a_policy_that_is_not_finite_at_zeros(algorithm):
    model = make(algorithm, Valid(), policy=Masked, net_arch=(8,))
    theta = model.actor.vector
    assert len(theta) == 8 * 3 + 9 * 2
    assert torch.distributions.Distribution._validate_args
    model.learn(60)
    assert all_finite(model)
    assert len(model.actor) == len(theta)
    assert not torch.equal(model.actor.vector, theta)


class Attention(BaseFeaturesExtractor):
    """Each entry of the observation is a token."""

    def __init__(self, observation_space, layer="attention"):
        super().__init__(observation_space, features_dim=4 * observation_space.shape[0])
        self.embed = nn.Linear(2, 4)
        self.layer = (
            nn.MultiheadAttention(4, 2, batch_first=True)
            if layer == "attention"
            else nn.TransformerEncoderLayer(4, 2, 6, dropout=0.0, batch_first=True)
        )

    def forward(self, observations):
        x = observations.to(self.embed.weight.dtype)
        positions = torch.arange(x.shape[1], dtype=x.dtype).expand_as(x)
        tokens = self.embed(torch.stack([x, positions], dim=-1))
        if isinstance(self.layer, nn.MultiheadAttention):
            return self.layer(tokens, tokens, tokens, need_weights=False)[0].flatten(1)
        return self.layer(tokens).flatten(1)


def attention(layer):
    return {
        "features_extractor_class": Attention,
        "features_extractor_kwargs": {"layer": layer},
        "net_arch": [],
    }


LAYERS = pytest.mark.parametrize("layer", ["attention", "encoder"])


@LAYERS
def test_products_through_attention_are_finite_differences(layer):
    """With κ = 0, Hv = (1/n) Σ_i A_i (σ_i σ_iᵀv + ∂σ_i/∂v)."""
    torch.manual_seed(0)
    policy = ActorCriticPolicy(
        spaces.Box(-np.inf, np.inf, (2,)), spaces.Discrete(3), lambda _: 1e-3, **attention(layer)
    )
    policy.to(torch.float64).set_training_mode(False)
    batch = frozen_episodes(policy)
    actor = find_actor(policy, batch.observations)
    vector = functional.normalize(torch.randn(len(actor), dtype=torch.float64), dim=0)
    product = EpisodeDerivatives(policy, actor, batch, Causal(0.0)).hessian_product(vector)

    def gradient(step):
        origin = actor.vector
        actor.assign(origin + step * vector)
        found = EpisodeDerivatives(policy, actor, batch, Causal(0.0)).gradient()
        actor.assign(origin)
        return found

    sigma = scores(policy, actor, batch)
    weights = torch.from_numpy(batch.cost_advantages)
    outer = sigma.T @ (weights * (sigma @ vector)) / batch.size
    curvature = (gradient(1e-5) - gradient(-1e-5)) / 2e-5
    torch.testing.assert_close(product, outer + curvature, rtol=1e-6, atol=1e-7)


@LAYERS
def test_attention_is_trained_and_certified(layer):
    model = make(CRPN, policy_kwargs=attention(layer))
    theta = model.actor.vector
    model.learn(40)
    assert not torch.equal(model.actor.vector, theta)
    ppo = PPO("MlpPolicy", Drift(), policy_kwargs=attention(layer), device="cpu", seed=0)
    report = certify_sosp(ppo, 4, 1.0, env=several(2), seed=0)
    assert np.isfinite(report.lambda_min.estimate)


@both
@pytest.mark.parametrize("learnt", [False, True])
@pytest.mark.parametrize("dim", [0, 1])
def test_policies_and_models_can_be_copied(algorithm, learnt, dim):
    model = make(algorithm, several(2, dim=dim))
    assert len(model.actor) > 0
    if learnt:
        model.learn(30)
        model.estimate_curvature(2)
        certify_sosp(model, 4, 1.0, env=several(2, dim=dim))
    expected = tensors(model)
    policy, other = copy.deepcopy(model.policy), copy.deepcopy(model)
    theta = model.actor.vector
    for copied in (other, model):
        torch.manual_seed(1)
        copied.learn(30)
        assert not torch.equal(copied.actor.vector, theta)
    assert same(other, tensors(model))
    assert all(torch.equal(policy.state_dict()[k], v) for k, v in expected.items())


class Interrupts:
    """Raises KeyboardInterrupt at the end of call number ``at`` of a function."""

    def __init__(self, function, at):
        self.function, self.at, self.calls = function, at, 0

    def patch(self, monkeypatch, owner, name):
        def call(*args, **kwargs):
            result = self.function(*args, **kwargs)
            self.calls += 1
            if self.calls == self.at:
                raise KeyboardInterrupt
            return result

        monkeypatch.setattr(owner, name, call)
        return self


PLACES = {
    "no_grad": (torch.no_grad, "__enter__"),
    "evaluate": (CandidateEvaluator, "evaluate"),
    "move": (CandidateEvaluator, "move"),
    "optimizer": (torch.optim.Adam, "step"),
}


@pytest.mark.parametrize("place", PLACES)
def test_an_interrupt_changes_the_policy_as_a_whole_or_not_at_all(place, monkeypatch):
    """Autograd is enabled again, although ``torch.no_grad`` was interrupted."""
    owner, name = PLACES[place]
    function = getattr(owner, name)

    def fresh():
        return make(CRPN, n_episodes=3, n_reused_rollouts=0)

    counted = Interrupts(function, None).patch(monkeypatch, owner, name)
    model = fresh()
    counted.calls, before = 0, tensors(model)
    after = tensors(model.learn(1))
    monkeypatch.undo()
    n_unchanged = 0
    for at in sorted({1 + i * (counted.calls - 1) // 7 for i in range(8)}):
        model = fresh()
        Interrupts(function, at).patch(monkeypatch, owner, name)
        with pytest.raises(KeyboardInterrupt):
            model.learn(1)
        monkeypatch.undo()
        assert torch.is_grad_enabled()
        assert same(model, before) or same(model, after)
        n_unchanged += same(model, before)
        model.learn(1)
        assert not same(model, before)
    assert n_unchanged > 0


@pytest.mark.parametrize("call", ["certify", "estimate", "load"])
def test_an_interrupt_of_other_calls_leaves_autograd_on(call, monkeypatch, tmp_path):
    model = make(CRPN, several(2))
    model.save(tmp_path / "model")
    calls = {
        "certify": lambda: certify_sosp(model, 4, 1.0, env=several(2), seed=0),
        "estimate": lambda: model.estimate_curvature(2),
        "load": lambda: CRPN.load(Path(tmp_path / "model"), device="cpu").actor,
    }
    with torch.no_grad():
        calls[call]()  # takes no notice
        assert not torch.is_grad_enabled()
    if call == "load":
        return
    enter = torch.no_grad.__enter__
    for at in (1, 5):
        Interrupts(enter, at).patch(monkeypatch, torch.no_grad, "__enter__")
        with pytest.raises(KeyboardInterrupt):
            calls[call]()
        monkeypatch.undo()
        assert torch.is_grad_enabled()
    assert same(model, tensors(model))


def test_dictionaries_of_observations_find_the_same_actor():
    space = spaces.Dict({"a": spaces.Box(-1.0, 1.0, (2,)), "b": spaces.Discrete(3)})
    model = make(CRPN, Sampler(space, spaces.Discrete(2)), policy="MultiInputPolicy")
    before = [id(tensor) for tensor in model.actor.tensors]
    model.learn(40)
    model.policy.action_net.requires_grad_(False)
    assert [id(t) for t in model.actor.tensors] == before[:-2]


class Hook(BaseCallback):
    """Calls a function once, at the 20th step."""

    def __init__(self, action):
        super().__init__()
        self.action = action

    def _on_step(self):
        if self.n_calls == 20:
            self.action(self.model)
        return True


@both
@pytest.mark.parametrize("rollout", ["episodes", "timesteps"])
def test_a_copy_made_in_mid_rollout_learns(algorithm, rollout):
    copies = []
    model = make(algorithm, several(2), rollout=rollout)
    model.learn(96, Hook(lambda model: copies.append(copy.deepcopy(model))))
    (copied,) = copies
    theta = copied.actor.vector
    copied.set_env(several(2))
    copied.learn(96)
    assert not torch.equal(copied.actor.vector, theta)


@pytest.mark.parametrize("rollout", ["episodes", "timesteps"])
def test_an_environment_set_in_mid_rollout_is_reset_before_its_first_step(rollout):
    other = several(2)
    model = make(CRPN, several(2), rollout=rollout)
    model.learn(96, Hook(lambda model: model.set_env(other)))
    model.learn(96, reset_num_timesteps=False)
    assert [env.resets > 0 for env in other.envs] == [True, True]
