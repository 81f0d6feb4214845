import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy, MultiInputActorCriticPolicy
from torch import nn

from sb3_crpn.parameters import ActorParameters
from tests.policies import ACTION_SPACES, OBSERVATION_SPACE, small_policy


def reachable_names(policy, observations):
    distribution = policy.get_distribution(observations)
    log_prob = distribution.log_prob(distribution.mode().detach())
    actor = ActorParameters.reachable(policy, log_prob)
    by_identity = {id(p): name for name, p in policy.named_parameters()}
    return [by_identity[id(tensor)] for tensor in actor.tensors]


def policy_of(action_space="discrete", cls=ActorCriticPolicy, space=OBSERVATION_SPACE, **options):
    return cls(space, ACTION_SPACES[action_space], lambda _: 1e-3, **options)


ZEROS = torch.zeros(1, 2)


def test_only_the_actor_of_separate_networks_is_reached():
    names = reachable_names(policy_of(net_arch=[3]), ZEROS)
    assert names == [
        "mlp_extractor.policy_net.0.weight",
        "mlp_extractor.policy_net.0.bias",
        "action_net.weight",
        "action_net.bias",
    ]


def test_a_gaussian_scale_comes_first_as_in_named_parameters():
    names = reachable_names(policy_of("gaussian", net_arch=[]), ZEROS)
    assert names == ["log_std", "action_net.weight", "action_net.bias"]


IMAGES = spaces.Dict({"image": spaces.Box(0, 255, (3, 36, 36), np.uint8), "x": OBSERVATION_SPACE})
IMAGE_ZEROS = {"image": torch.zeros(1, 3, 36, 36), "x": ZEROS}


@pytest.mark.parametrize("share", [True, False])
def test_a_shared_features_extractor_belongs_to_the_actor(share):
    policy = policy_of(
        cls=MultiInputActorCriticPolicy, space=IMAGES, share_features_extractor=share, net_arch=[]
    )
    names = reachable_names(policy, IMAGE_ZEROS)
    prefixes = [name.split(".")[0] for name in names]
    assert set(prefixes) == {"features_extractor", "action_net"}
    assert len(names) == len(list(policy.pi_features_extractor.parameters())) + 2
    assert names[-2:] == ["action_net.weight", "action_net.bias"]


def test_frozen_tensors_are_left_out():
    policy = policy_of(net_arch=[3])
    policy.action_net.bias.requires_grad_(False)
    names = reachable_names(policy, ZEROS)
    assert "action_net.bias" not in names
    assert "action_net.weight" in names


class Renamed(ActorCriticPolicy):
    """The actor reads a tensor named after the value. A layer named after the actor is unused."""

    def _build(self, lr_schedule):
        super()._build(lr_schedule)
        self.value_temperature = nn.Parameter(torch.ones(1))
        self.action_unused = nn.Linear(2, 2)

    def _get_action_dist_from_latent(self, latent_pi):
        return super()._get_action_dist_from_latent(latent_pi * self.value_temperature)


def test_names_do_not_matter():
    names = reachable_names(policy_of(cls=Renamed, net_arch=[]), ZEROS)
    assert names == ["value_temperature", "action_net.weight", "action_net.bias"]


def test_the_order_is_that_of_named_parameters():
    policy = policy_of("gaussian", net_arch=[3])
    names = reachable_names(policy, ZEROS)
    assert names == [name for name, _ in policy.named_parameters() if name in names]


def test_a_policy_without_trainable_parameters_is_an_error():
    policy = policy_of(net_arch=[])
    policy.requires_grad_(False)
    with pytest.raises(ValueError, match="requires_grad=True"):
        reachable_names(policy, ZEROS)
    with pytest.raises(ValueError, match="no trainable parameter"):
        ActorParameters([])


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_the_vector_goes_round_bitwise(dtype):
    _, actor = small_policy("gaussian", dtype=torch.float32)
    actor = ActorParameters([nn.Parameter(tensor.detach().to(dtype)) for tensor in actor.tensors])
    vector, tensors = actor.vector, actor.snapshot()
    assert vector.dtype == torch.float64
    assert vector.shape == (len(actor),)
    assert torch.equal(vector, torch.cat([t.flatten().double() for t in tensors]))
    actor.assign(torch.zeros(len(actor)))
    assert not actor.vector.any()
    actor.assign(vector)
    for parameter, tensor in zip(actor.tensors, tensors, strict=True):
        assert torch.equal(parameter, tensor)
        assert parameter.dtype == dtype


def test_the_vector_is_a_copy():
    _, actor = small_policy("discrete")
    before = actor.snapshot()
    actor.vector.add_(1.0)
    assert all(torch.equal(a, b) for a, b in zip(actor.tensors, before, strict=True))


def test_flatten_and_unflatten_are_inverse():
    _, actor = small_policy("gaussian", dtype=torch.float32)
    vector = torch.arange(float(len(actor)), dtype=torch.float64)
    pieces = actor.unflatten(vector)
    assert [p.shape for p in pieces] == [t.shape for t in actor.tensors]
    assert {p.dtype for p in pieces} == {torch.float32}
    assert torch.equal(actor.flatten(pieces), vector)
    assert actor.device == torch.device("cpu")


def test_snapshots_are_restored_bitwise():
    _, actor = small_policy("discrete", dtype=torch.float32)
    actor.assign(torch.rand(len(actor), generator=torch.Generator().manual_seed(0)) / 3.0)
    vector, tensors = actor.vector, actor.snapshot()
    actor.assign(vector * 1.1 + 0.1)
    assert not torch.equal(actor.vector, vector)
    actor.load(tensors)
    assert torch.equal(actor.vector, vector)
    assert all(p.requires_grad for p in actor.tensors)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda v: v[:-1], r"shape \(20,\), must be \(21,\)"),
        (lambda v: v[None], r"shape \(1, 21\), must be \(21,\)"),
        (lambda v: v * torch.nan, "non-finite"),
        (lambda v: torch.cat([v[:-1], torch.tensor([torch.inf])]), "non-finite"),
    ],
)
def test_a_vector_that_is_refused_changes_nothing(spoil, message):
    _, actor = small_policy("discrete")
    before = actor.vector
    with pytest.raises(ValueError, match=message):
        actor.assign(spoil(before.clone() + 1.0))
    assert torch.equal(actor.vector, before)


def test_a_vector_beyond_the_parameters_precision_changes_nothing():
    _, actor = small_policy("discrete", dtype=torch.float32)
    before = actor.vector
    with pytest.raises(ValueError, match="finite"):
        actor.assign(torch.full((len(actor),), 1e300, dtype=torch.float64))
    assert torch.equal(actor.vector, before)
