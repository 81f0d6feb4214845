"""Fitting the critic."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn
from torch.nn import functional

from sb3_crpn.episodes import EpisodeBatch, Observations
from sb3_crpn.episodes.batch import FloatArray, map_observations
from sb3_crpn.parameters import ActorParameters


def fit_critic(
    policy: ActorCriticPolicy,
    actor: ActorParameters,
    batch: EpisodeBatch,
    *,
    n_epochs: int,
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
        The episodes.
    n_epochs, batch_size
        Passes over the steps of the batch, in random minibatches of this size.
    rng
        Of the minibatches.

    Returns
    -------
    float
        The mean loss over all minibatches, in the rewards' units (nan for no epochs). Returns or a
        loss that are not finite end the fit with the parameters as they are: infinity.
    """
    if not np.isfinite(batch.returns).all():
        return float("inf")
    if not n_epochs:
        return float("nan")
    # not in training mode: a normalisation layer's statistics may be the actor's too
    policy.set_training_mode(False)
    layer = _output_layer(policy, actor)
    shift, scale = (0.0, 1.0) if layer is None else _units(batch.returns)
    returns = torch.as_tensor(
        (batch.returns - shift) / scale, dtype=torch.float32, device=policy.device
    )
    losses = []
    with _in_units(layer, shift, scale):
        for _ in range(n_epochs):
            order = torch.as_tensor(rng.permutation(batch.n_steps), device=policy.device)
            for chosen in torch.split(order, batch_size):
                values = policy.predict_values(_at(batch.observations, chosen)).flatten()
                loss = functional.mse_loss(values, returns[chosen])
                losses.append(loss.item())
                if not np.isfinite(losses[-1]):
                    return float("inf")
                policy.optimizer.zero_grad()
                torch.autograd.backward(loss)
                for parameter in actor.tensors:
                    parameter.grad = None  # the optimiser passes over it
                policy.optimizer.step()
    return float(np.mean(losses)) * scale**2


def _at(observations: Observations, steps: torch.Tensor) -> Observations:
    return map_observations(observations, lambda tensor: tensor[steps])


def _units(returns: FloatArray) -> tuple[float, float]:
    """Return the mean and the standard deviation of the returns, the latter never negligible."""
    shift = float(returns.mean())
    floor = 0.01 * float(np.abs(returns).max())
    return shift, max(float(returns.std()), floor) or 1.0


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
