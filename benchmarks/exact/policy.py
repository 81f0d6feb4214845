"""θ of an SB3 model with ``net_arch=[]``, in the order of :class:`TabularMDP`."""

from __future__ import annotations

from stable_baselines3.common.policies import ActorCriticPolicy
from torch import Tensor
from torch.nn.utils import parameters_to_vector, vector_to_parameters


def actor_vector(policy: ActorCriticPolicy) -> Tensor:
    """Return the weight and the bias of ``action_net`` as one float64 vector [d]."""
    return parameters_to_vector(policy.action_net.parameters()).detach().double()


def assign_actor(policy: ActorCriticPolicy, theta: Tensor) -> None:
    """Set the weight and the bias of ``action_net``."""
    dtype = next(policy.action_net.parameters()).dtype
    vector_to_parameters(theta.to(dtype), policy.action_net.parameters())
