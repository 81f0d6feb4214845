"""Small float64 policies, fixed episodes, and their scores computed one by one."""

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_crpn.curvature import Causal, Trajectory
from sb3_crpn.episodes import EpisodeBatch
from sb3_crpn.episodes.batch import episode_starts
from sb3_crpn.parameters import ActorParameters

OBSERVATION_SPACE = spaces.Box(-np.inf, np.inf, (2,), np.float32)
ACTION_SPACES = {
    "discrete": spaces.Discrete(3),
    "gaussian": spaces.Box(-1.0, 1.0, (2,), np.float32),
    "multidiscrete": spaces.MultiDiscrete([2, 3]),
    "multibinary": spaces.MultiBinary(2),
}


class Features(FlattenExtractor):
    """x ↦ Px in the policy's precision. SB3's extractors return float32."""

    def __init__(self, observation_space, mixing=None):
        super().__init__(observation_space)
        self.register_buffer("mixing", torch.eye(2) if mixing is None else mixing)

    def forward(self, observations):
        return super().forward(observations).to(self.mixing.dtype) @ self.mixing.T


def small_policy(kind, *, net_arch=(3,), dtype=torch.float64, mixing=None):
    """A policy and its actor's parameters."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        policy = ActorCriticPolicy(
            OBSERVATION_SPACE,
            ACTION_SPACES[kind],
            lambda _: 1e-3,
            net_arch=list(net_arch),
            ortho_init=False,
            features_extractor_class=Features,
            features_extractor_kwargs={"mixing": mixing},
        )
    policy.to(dtype).set_training_mode(False)
    distribution = policy.get_distribution(torch.zeros(1, 2))
    log_prob = distribution.log_prob(distribution.mode().detach())
    return policy, ActorParameters.reachable(policy, log_prob)


def frozen_episodes(policy, lengths=(3, 1, 4, 2), seed=0):
    """Random observations, actions of the policy, and normally distributed cost advantages A_i."""
    rng = np.random.default_rng(seed)
    n_steps = sum(lengths)
    observations = torch.from_numpy(rng.normal(size=(n_steps, 2))).float()
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(seed)
        actions = policy.get_distribution(observations).sample()
    return EpisodeBatch(
        observations=observations,
        actions=actions,
        lengths=np.array(lengths),
        cost_advantages=rng.normal(size=n_steps),
        values=rng.normal(size=n_steps),
        returns=rng.normal(size=n_steps),
        rewards=rng.normal(size=n_steps),
        log_probs=rng.normal(size=n_steps),
        next_observations=torch.from_numpy(rng.normal(size=(len(lengths), 2))).float(),
        bootstrapped=rng.random(len(lengths)) < 0.5,
        times=np.zeros(len(lengths), dtype=int),
        trajectories=np.arange(len(lengths)),
    )


def log_probabilities(policy, batch):
    return policy.get_distribution(batch.observations).log_prob(batch.actions)


def episode_slices(batch):
    starts = episode_starts(batch.lengths)
    return [slice(s, s + n) for s, n in zip(starts, batch.lengths, strict=True)]


def flat_gradient(output, actor, **options):
    """∇output as a vector [d]."""
    gradients = torch.autograd.grad(
        output, actor.tensors, retain_graph=True, materialize_grads=True, **options
    )
    return actor.flatten(gradients)


def scores(policy, actor, batch):
    """σ_i, [T, d]."""
    return torch.stack([flat_gradient(x, actor) for x in log_probabilities(policy, batch)])


def log_hessians(policy, actor, batch):
    """∇²log π_i, [T, d, d]."""
    hessians = []
    for log_prob in log_probabilities(policy, batch):
        score = flat_gradient(log_prob, actor, create_graph=True)
        hessians.append(torch.stack([flat_gradient(entry, actor) for entry in score]))
    return torch.stack(hessians)


ESTIMATORS = [("trajectory", 1.0), *(("causal", decay) for decay in (0.0, 0.5, 0.9, 1.0))]


def estimator_of(name, decay=1.0):
    """The Hessian estimator of DESIGN section 2."""
    return Trajectory() if name == "trajectory" else Causal(decay)


def pair_matrix(estimator, decay, weights):
    """W of DESIGN section 2 for one episode, [T, T]."""
    time = np.arange(len(weights))
    if estimator == "trajectory":
        return 0.5 * (weights[:, None] + weights[None, :])
    return decay ** np.abs(time[:, None] - time) * weights[np.maximum(time[:, None], time)]


def dense_hessian(policy, actor, batch, estimator, decay):
    """(1/n) Σ_episodes [Σ_ij W_ij σ_i σ_jᵀ + Σ_i A_i ∇²log π_i], [d, d]."""
    sigma, curvature = scores(policy, actor, batch), log_hessians(policy, actor, batch)
    total = torch.einsum("t,tij->ij", torch.from_numpy(batch.cost_advantages), curvature)
    for steps in episode_slices(batch):
        W = torch.from_numpy(pair_matrix(estimator, decay, batch.cost_advantages[steps]))
        total = total + sigma[steps].T @ W @ sigma[steps]
    return total / batch.n_episodes


def central_jacobian(function, actor, step=1e-5):
    """∂function/∂θ at θ by central differences; column j is the derivative along θ_j."""
    origin = actor.vector
    columns = []
    for direction in step * torch.eye(len(actor), dtype=torch.float64):
        actor.assign(origin + direction)
        ahead = function()
        actor.assign(origin - direction)
        columns.append((ahead - function()) / (2.0 * step))
    actor.assign(origin)
    return torch.stack(columns, dim=1)
