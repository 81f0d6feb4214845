import numpy as np
import pytest
import torch

from sb3_crpn.policy import ActorFinder
from tests.policies import small_policy


def test_the_actor_is_looked_for_again_where_the_policy_has_others():
    policy, finder = small_policy("gaussian")[0], ActorFinder()
    space = policy.observation_space
    actor = finder.find(policy, space, None)
    assert finder.find(policy, space, np.zeros((1, 2), np.float32)) is actor
    policy.action_net.weight.requires_grad_(False)
    frozen = finder.find(policy, space, None)
    assert len(actor) - len(frozen) == policy.action_net.weight.numel()
    policy.action_net = torch.nn.Linear(policy.action_net.in_features, 2).double()
    replaced = finder.find(policy, space, None)
    assert any(tensor is policy.action_net.weight for tensor in replaced.tensors)
    for parameter in policy.parameters():
        parameter.requires_grad_(False)
    with pytest.raises(ValueError, match="no trainable parameter"):
        finder.find(policy, space, None)
