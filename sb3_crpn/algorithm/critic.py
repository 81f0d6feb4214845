"""Fitting the critic."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn
from torch.nn import functional

from sb3_crpn.arrays import Observations
from sb3_crpn.episodes import EpisodeBatch
from sb3_crpn.episodes.observations import take_rows
from sb3_crpn.parameters import ActorParameters
from sb3_crpn.policy import state_values


def fit_critic(
    policy: ActorCriticPolicy,
    actor: ActorParameters,
    batch: EpisodeBatch,
    *,
    n_minibatches: int,
    batch_size: int,
    rng: np.random.Generator,
) -> float:
    """Minimise Σ_i (V(s_i) - R_i)² over the critic's own parameters, R_i the λ-returns.

    The fit runs in units in which the returns have mean 0 and standard deviation 1, so that the
    learning rate means the same whatever the scale of the rewards; V itself stays in theirs.

    Parameters
    ----------
    policy
        Its optimiser makes the steps.
    actor
        Parameters that stay as they are, also where the critic shares them.
    batch
        The episodes. With several ranks gradients, losses and units are those of all of them.
    n_minibatches, batch_size
        How many minibatches of this size, in random passes over the steps of all ranks' batches;
        each rank contributes to them in proportion to its steps.
    rng
        Of the minibatches.

    Returns
    -------
    float
        The mean loss over all minibatches, in the rewards' units (nan for none). Returns or a
        loss that are not finite end the fit with the parameters as they are: infinity.
    """
    largest = float(np.abs(batch.returns).max(initial=0.0))
    largest = batch.largest(largest if np.isfinite(largest) else float("inf"))
    if np.isinf(largest):
        return float("inf")
    if not n_minibatches:
        return float("nan")
    # not in training mode: a normalisation layer's statistics may be the actor's too
    policy.set_training_mode(False)
    _follow_replaced(policy)
    layer = _output_layer(policy, actor)
    shift, scale = (0.0, 1.0) if layer is None else _units(batch, largest)
    dtype = next(policy.parameters()).dtype
    returns = torch.as_tensor((batch.returns - shift) / scale, dtype=dtype, device=policy.device)
    losses = []
    with _in_units(layer, shift, scale):
        for chosen in _minibatches(batch, n_minibatches, batch_size, rng, policy.device):
            policy.optimizer.zero_grad()
            loss = _backward(policy, take_rows(batch.observations, chosen), returns[chosen])
            for parameter in actor.tensors:
                parameter.grad = None  # the optimiser passes over it
            losses.append(_average(policy, actor, batch, loss, len(chosen)))
            if not np.isfinite(losses[-1]):
                return float("inf")
            policy.optimizer.step()
    return float(np.mean(losses)) * scale**2


def has_own_parameters(policy: ActorCriticPolicy, actor: ActorParameters) -> bool:
    """Whether V depends on parameters that are trainable and not the actor's."""
    return bool(_own_parameters(policy, actor))


def _own_parameters(policy: ActorCriticPolicy, actor: ActorParameters) -> list[nn.Parameter]:
    fixed = {id(tensor) for tensor in actor.tensors}
    return [p for p in policy.parameters() if p.requires_grad and id(p) not in fixed]


def fuse(optimizer: torch.optim.Optimizer) -> None:
    """Let Adam update all tensors in one kernel, unless its user has said how it is to run.

    The same to rounding, and on small networks a fifth of a minibatch's time less.
    """
    if not isinstance(optimizer, torch.optim.Adam):
        return
    for group in optimizer.param_groups:
        devices = {parameter.device.type for parameter in group["params"]}
        unset = group["fused"] is None and group["foreach"] is None
        if unset and devices <= {"cpu", "cuda"}:
            group["fused"] = True


def _follow_replaced(policy: ActorCriticPolicy) -> None:
    """Let the optimiser hold the policy's parameters where layers of it were replaced."""
    optimizer = policy.optimizer
    present = {parameter: index for index, parameter in enumerate(policy.parameters())}
    held = {parameter for group in optimizer.param_groups for parameter in group["params"]}
    if held <= present.keys():
        return
    for gone in held - present.keys():
        optimizer.state.pop(gone, None)
    for group in optimizer.param_groups:
        group["params"] = [p for p in group["params"] if p in present]
    first = optimizer.param_groups[0]["params"]
    first += [parameter for parameter in present if parameter not in held]
    first.sort(key=present.__getitem__)  # a saved state lists them by position


def _minibatches(
    batch: EpisodeBatch,
    number: int,
    batch_size: int,
    rng: np.random.Generator,
    device: torch.device,
) -> Iterator[torch.Tensor]:
    """Yield this rank's steps of each minibatch: equally many minibatches on every rank."""
    total = batch.total_steps
    per_pass = math.ceil(total / batch_size)
    size = max(1, math.ceil(batch_size * batch.n_steps / total))
    for index in range(number):
        start = index % per_pass * size
        if start == 0:
            order = torch.as_tensor(rng.permutation(batch.n_steps), device=device)
        yield order[start : start + size]


def _backward(
    policy: ActorCriticPolicy, observations: Observations, returns: torch.Tensor
) -> float:
    """Leave the gradient of the mean squared error in the parameters, and return the error."""
    if not len(returns):
        return 0.0
    loss = functional.mse_loss(state_values(policy, observations), returns)
    torch.autograd.backward(loss)
    return loss.item()


def _average(
    policy: ActorCriticPolicy,
    actor: ActorParameters,
    batch: EpisodeBatch,
    loss: float,
    n_steps: int,
) -> float:
    """Replace gradients and loss by their means over all ranks' steps, in one message."""
    if batch.is_whole:
        return loss
    own = _own_parameters(policy, actor)
    gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in own]
    flat = torch.cat([gradient.reshape(-1) for gradient in gradients])
    total = batch.total(n_steps * torch.cat([flat, flat.new_tensor([loss, 1.0])]))
    *means, last = torch.split(total / total[-1], [*(p.numel() for p in own), 2])
    for parameter, gradient in zip(own, means, strict=True):
        parameter.grad = gradient.view_as(parameter).to(parameter.dtype)
    return float(last[0])


def _units(batch: EpisodeBatch, largest: float) -> tuple[float, float]:
    """Return the mean and the standard deviation of the returns, the latter never negligible."""
    shift, variance = batch.moments(batch.returns)
    return shift, max(math.sqrt(variance), 0.01 * largest) or 1.0


def _output_layer(policy: ActorCriticPolicy, actor: ActorParameters) -> nn.Linear | None:
    """Return the affine layer that V comes out of; custom policies may have none of its own."""
    layer = getattr(policy, "value_net", None)
    if not isinstance(layer, nn.Linear) or layer.bias is None:
        return None
    fixed = {id(tensor) for tensor in actor.tensors}
    own = all(p.requires_grad and id(p) not in fixed for p in layer.parameters())
    return layer if own else None


@contextmanager
def _in_units(layer: nn.Linear | None, shift: float, scale: float) -> Iterator[None]:
    """Let the layer give (V - shift) / scale inside the block, and V again after it.

    The change of units leaves V as it is, as in van Hasselt et al., Learning values across many
    orders of magnitude, NeurIPS 2016, eq. 3.
    """
    if layer is None:
        yield
        return
    with torch.no_grad():
        layer.weight.div_(scale)
        layer.bias.sub_(shift).div_(scale)
    try:
        yield
    finally:
        with torch.no_grad():
            layer.weight.mul_(scale)
            layer.bias.mul_(scale).add_(shift)
