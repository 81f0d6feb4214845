"""The paper's estimators, computed episode by episode in float64 by autograd."""

import copy
from itertools import pairwise

import numpy as np
import torch


def paper_estimates(model, theta, buffer, quota):
    """Return ∇J and ∇²J of Theorem 1 (symmetrised) at ``theta``, and the episodes' lengths.

    The episodes are the first ``quota`` of each environment in the buffer.
    """
    policy = copy.deepcopy(model.policy).double()
    actor = copy.deepcopy(model.actor)
    names = [name for name, p in model.policy.named_parameters() if _is_one_of(p, model.actor)]
    actor.tensors = tuple(dict(policy.named_parameters())[name] for name in names)
    actor.assign(theta)

    gradients, hessians, lengths = [], [], []
    for env in range(buffer.n_envs):
        starts = np.flatnonzero(buffer.episode_starts[: buffer.pos, env])
        bounds = [*starts, buffer.pos][: quota + 1]
        for start, stop in pairwise(bounds):
            steps = slice(int(start), int(stop))
            gradient, hessian = _episode(
                policy,
                actor,
                torch.as_tensor(buffer.observations[steps, env]).double(),
                torch.as_tensor(buffer.actions[steps, env]).double(),
                buffer.rewards[steps, env].astype(float),
                model.gamma,
            )
            gradients.append(gradient)
            hessians.append(hessian)
            lengths.append(int(stop - start))
    return sum(gradients) / len(gradients), sum(hessians) / len(hessians), lengths


def _is_one_of(parameter, actor):
    return any(parameter is tensor for tensor in actor.tensors)


def _episode(policy, actor, observations, actions, rewards, gamma):
    """Σ Ψ_i σ_i and sym[(Σ Ψ_i σ_i)(Σ σ_j)ᵀ] + Σ Ψ_i ∇²log π_i of one episode."""
    discounted = gamma ** np.arange(len(rewards)) * rewards
    psi = [-sum(discounted[i:]) for i in range(len(rewards))]
    if policy.action_space.shape == ():
        actions = actions.flatten()
    # get_distribution would turn the observations into float32
    latent = policy.mlp_extractor.forward_actor(observations)
    log_probs = policy._get_action_dist_from_latent(latent).log_prob(actions)
    weighted = sum(psi_i * log_prob for psi_i, log_prob in zip(psi, log_probs, strict=True))
    gradient = _flat_gradient(weighted, actor, create_graph=True)
    scores = _flat_gradient(log_probs.sum(), actor, create_graph=True).detach()
    curvature = torch.stack([_flat_gradient(entry, actor) for entry in gradient])
    outer = torch.outer(gradient.detach(), scores)
    return gradient.detach(), curvature + (outer + outer.T) / 2


def _flat_gradient(scalar, actor, create_graph=False):
    return actor.flatten(
        torch.autograd.grad(
            scalar,
            actor.tensors,
            retain_graph=True,
            create_graph=create_graph,
            materialize_grads=True,
        )
    )
