"""Models and batch means with known gradient and Hessian."""

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks.exact import TabularEnv, assign_actor, coordination_mdp, random_mdp
from sb3_crpn.sosp.batch_means import BatchMeans

SADDLE = torch.zeros(6, dtype=torch.float64)


def tabular(mdp, theta, algorithm=PPO, n_envs=1, **arguments):
    """A model whose policy is softmax-linear with the given parameters.

    A step of many environments takes hardly longer than one's: where there are many episodes.
    """
    env = DummyVecEnv([lambda: TabularEnv(mdp)] * n_envs)
    options = {"gamma": mdp.gamma, "policy_kwargs": {"net_arch": []}, "seed": 0, **arguments}
    model = algorithm("MlpPolicy", env, device="cpu", **options)
    assign_actor(model.policy, theta)
    return model


def saddle(algorithm=PPO, **arguments):
    return tabular(coordination_mdp(), SADDLE, algorithm, **arguments)


def blind():
    """An MDP with aliased states. Its optimal policy is stochastic, and the optimum is finite."""
    return random_mdp(26, n_states=4, n_observations=1, horizon=4, gamma=1.0)


def optimised(mdp, n_steps=300):
    theta = torch.randn(
        mdp.n_parameters, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    for _ in range(n_steps):
        theta = theta - mdp.gradient(theta)
    return theta


def noisy_sample(gradient, hessian, noise, n_blocks, seed):
    """Blocks with Gaussian noise around a known gradient and Hessian."""
    generator = torch.Generator().manual_seed(seed)
    d = len(gradient)
    shape = {"dtype": torch.float64, "generator": generator}
    gradients = gradient + noise * torch.randn(n_blocks, d, **shape)
    root = torch.randn(n_blocks, d, d, **shape)
    return BatchMeans.from_matrices(
        gradients,
        hessian + 0.5 * noise * (root + root.transpose(1, 2)),
        torch.zeros(d, d, dtype=torch.float64),
    )
