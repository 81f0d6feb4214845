"""The only caller of Stable-Baselines3's policy methods: distributions, values, actions, the actor.

The policy is asked anew each time, so that one that was replaced, frozen or unfrozen is the one
that acts and trains. It is to be in evaluation mode.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from operator import is_not
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector.utils import create_empty_array
from stable_baselines3.common.distributions import (
    Distribution,
    MultiCategoricalDistribution,
    kl_divergence,
)
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import obs_as_tensor
from torch import nn
from torch.nn.attention import SDPBackend, sdpa_kernel

from sb3_crpn.arrays import Array, Observations
from sb3_crpn.parameters import ActorParameters


def action_distribution(policy: ActorCriticPolicy, observations: Observations) -> Distribution:
    """Return π(·|s) at each of the ``observations``, differentiable twice.

    The result is a copy, and the policy's own distribution object is left as it was: SB3's
    policies reuse one, in which a graph would keep the policy from being copied and saved.
    """
    shared = vars(policy.action_dist)
    before = dict(shared)
    try:
        with _twice_differentiable(policy):
            return copy.copy(policy.get_distribution(observations))
    finally:
        shared.clear()
        shared.update(before)


def mean_divergence(old: Distribution, new: Distribution) -> torch.Tensor:
    """Return the mean of KL(old ‖ new) over the states and the action's k components, a scalar.

    The mean, not the sum, over components is what sb3-contrib's TRPO bounds: a step of one and
    the same divergence changes each component as much whether there are one or twenty.
    """
    divergence = kl_divergence(old, new)  # [T], or [T, k] where SB3 keeps the components apart
    if isinstance(old, MultiCategoricalDistribution):  # which SB3 sums
        divergence = divergence / len(old.action_dims)
    return divergence.mean()


def state_values(policy: ActorCriticPolicy, observations: Observations) -> torch.Tensor:
    """Return V(s) of each of the ``observations``, [T]."""
    with _recurrent_layers_differentiable(policy):
        return policy.predict_values(observations).flatten()


def values_and_log_probs(
    policy: ActorCriticPolicy, observations: Observations, actions: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return V(s_i) and log π(a_i|s_i), [T] each, without graphs."""
    with torch.no_grad():
        values, log_probs, _ = policy.evaluate_actions(observations, actions)
    return values.flatten(), log_probs


def sample_actions(policy: ActorCriticPolicy, observations: Observations) -> Array:
    """Draw a ~ π(·|s) from PyTorch's generator at each of the ``observations``, [n, …]."""
    with torch.no_grad():
        actions = policy.get_distribution(observations).get_actions()
    return actions.cpu().numpy().reshape(-1, *(policy.action_space.shape or ()))


def draw_noise(policy: ActorCriticPolicy, n_envs: int) -> None:
    """Draw gSDE's noise anew, a matrix for each environment."""
    policy.reset_noise(n_envs)


def environment_actions(policy: ActorCriticPolicy, actions: Array) -> Array:
    """Return sampled actions as the environment takes them: in the bounds of its space."""
    space = policy.action_space
    if not isinstance(space, spaces.Box):
        return actions
    if policy.squash_output:
        return policy.unscale_action(actions)
    clipped: Array = np.clip(actions, space.low, space.high)
    return clipped


def to_tensor(policy: ActorCriticPolicy, observations: Any) -> Observations:
    """Return a batch of observations as the policy takes them, on its device."""
    return obs_as_tensor(observations, policy.device)


def find_actor(policy: ActorCriticPolicy, observations: Observations) -> ActorParameters:
    """Select the parameters that log π depends on, by gradient reachability.

    Raises
    ------
    ValueError
        log π depends on no trainable parameter, or π(·|s) is not finite.
    """
    with torch.enable_grad():
        distribution = action_distribution(policy, observations)
        log_prob = distribution.log_prob(distribution.mode().detach())
        return ActorParameters.reachable(policy, log_prob)


def find_actor_anywhere(policy: ActorCriticPolicy, space: spaces.Space[Any]) -> ActorParameters:
    """Select the actor at an observation of zeros, which need not be one of the environment's.

    Reachability does not depend on values, so that a distribution that is not finite there is no
    hindrance.
    """
    zeros: Any = create_empty_array(space, 1)
    with _unvalidated_distributions():
        return find_actor(policy, policy.obs_to_tensor(zeros)[0])


class ActorFinder:
    """The actor of a policy, looked for anew where the policy has other trainable parameters.

    The policy, or layers of it, may be replaced, frozen or unfrozen at any time.
    """

    def __init__(self) -> None:
        self._parameters: list[nn.Parameter] = []
        self._trainable: list[bool] | None = None

    def find(
        self, policy: ActorCriticPolicy, space: spaces.Space[Any], observations: Any
    ) -> ActorParameters:
        """Return the actor, found at ``observations``; ``None``: anywhere in their ``space``."""
        parameters = list(policy.parameters())
        trainable = [parameter.requires_grad for parameter in parameters]
        if trainable != self._trainable or any(map(is_not, parameters, self._parameters)):
            policy.set_training_mode(False)
            if observations is None:
                self._actor = find_actor_anywhere(policy, space)
            else:
                self._actor = find_actor(policy, to_tensor(policy, observations))
            self._parameters, self._trainable = parameters, trainable
        return self._actor


@contextmanager
def unchanged_on_error(policy: ActorCriticPolicy) -> Iterator[None]:
    """Let the block change the policy as a whole or, where it ends by an exception, not at all.

    Ctrl-C included, wherever it strikes: parameters and buffers are then what they were, bit for
    bit, and gradients are recorded again.
    """
    tensors = [*policy.parameters(), *policy.buffers()]
    before = [tensor.detach().clone() for tensor in tensors]
    records = torch.is_grad_enabled()
    try:
        yield
    except BaseException:
        with torch.no_grad():
            for tensor, value in zip(tensors, before, strict=True):
                tensor.copy_(value)
        torch.set_grad_enabled(records)
        raise


@contextmanager
def _unvalidated_distributions() -> Iterator[None]:
    distributions = torch.distributions.Distribution
    before = distributions._validate_args
    distributions.set_default_validate_args(False)
    try:
        yield
    finally:
        distributions.set_default_validate_args(before)


@contextmanager
def _twice_differentiable(policy: ActorCriticPolicy) -> Iterator[None]:
    """Let the block build graphs of kernels that have second derivatives.

    PyTorch's fused attention and cuDNN's recurrent layers have none.
    """
    if not torch.is_grad_enabled():
        yield
        return
    with sdpa_kernel(SDPBackend.MATH), _recurrent_layers_differentiable(policy):
        yield


def _recurrent_layers_differentiable(policy: ActorCriticPolicy) -> AbstractContextManager[None]:
    """Avoid cuDNN where it has no derivative: for recurrent layers in evaluation mode."""
    recurrent = policy.device.type == "cuda" and any(
        isinstance(module, nn.RNNBase) for module in policy.modules()
    )
    return torch.backends.cudnn.flags(enabled=False) if recurrent else nullcontext()
