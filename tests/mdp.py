"""CRPN on small decision processes whose J(θ), ∇J and ∇²J are known exactly."""

import numpy as np
import torch
from scipy.stats import t as student
from stable_baselines3.common.env_util import make_vec_env

from benchmarks import exact
from benchmarks.exact import TabularEnv
from sb3_crpn import CRPN, PAPER


def random_mdp(seed, horizon=4, *, fixed_length=False):
    """Three states, two actions, and episodes of at most H steps."""
    max_stop = 0.0 if fixed_length else 0.5
    return exact.random_mdp(seed, n_states=3, horizon=horizon, gamma=0.8, max_stop=max_stop)


def tabular_crpn(mdp, *, n_envs=8, wrapper=None, policy="MlpPolicy", **arguments):
    """CRPN with the paper's estimators and a softmax-linear policy."""
    env = make_vec_env(lambda: TabularEnv(mdp), n_envs, seed=0, wrapper_class=wrapper)
    settings = {
        "policy_kwargs": {"net_arch": []},
        "gamma": mdp.gamma,
        "seed": 0,
        "device": "cpu",
        **PAPER,
        **arguments,
    }
    return CRPN(policy, env, **settings)


def random_parameters(mdp, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(mdp.n_parameters, dtype=torch.float64, generator=generator).float().double()


def differs(samples, truth, level=1e-6):
    """Return whether the mean of independent samples [n, …] differs from ``truth`` significantly.

    A two-sided t-test with Bonferroni's correction for the number of entries.
    """
    samples, truth = np.asarray(samples), np.asarray(truth)
    error = samples.std(0, ddof=1) / np.sqrt(len(samples))
    statistic = np.abs(samples.mean(0) - truth) / (error + 1e-12)
    return bool(statistic.max() > student.isf(level / 2 / statistic.size, len(samples) - 1))
