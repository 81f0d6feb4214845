"""A small Markov decision process whose J(θ), ∇J and ∇²J are known exactly."""

from dataclasses import dataclass, replace

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from scipy.stats import t as student
from stable_baselines3.common.env_util import make_vec_env

from sb3_crpn import CRPN, PAPER


@dataclass(frozen=True, eq=False)
class TabularMDP:
    """States S, actions A, cut after ``horizon`` steps; J = -E[Σ γ^h r_h], π softmax-linear.

    ``initial`` [S], ``transition`` [S, A, S], ``reward`` and ``stop`` (the probability that the
    episode terminates with the step) [S, A].
    """

    initial: torch.Tensor
    transition: torch.Tensor
    reward: torch.Tensor
    stop: torch.Tensor
    horizon: int
    gamma: float = 0.8

    @property
    def n_parameters(self):
        n_states, n_actions = self.reward.shape
        return n_actions * (n_states + 1)

    def probabilities(self, theta):
        """π(a|s), [S, A], for θ = the weight [A, S] and bias [A] of SB3's action_net."""
        n_states, n_actions = self.reward.shape
        weight, bias = theta.split([n_actions * n_states, n_actions])
        return torch.softmax(weight.view(n_actions, n_states).T + bias, dim=1)

    def action_values(self, theta):
        """Q_h(s, a) for h = 0, …, horizon - 1, [horizon, S, A]."""
        probabilities = self.probabilities(theta)
        values = [self.reward]
        for _ in range(self.horizon - 1):
            after = self.transition @ (probabilities * values[0]).sum(1)
            values.insert(0, self.reward + self.gamma * (1 - self.stop) * after)
        return torch.stack(values)

    def cost(self, theta):
        """J(θ)."""
        first = (self.probabilities(theta) * self.action_values(theta)[0]).sum(1)
        return -(self.initial @ first)

    def surrogate(self, theta, at, visitation_discount):
        """-Σ_h c^h E_{s_h ~ at}[Σ_a π(a|s_h; θ) Q_h(s_h, a)]: ∇ is ∇J for c = γ, ∇² is not ∇²J."""
        behaviour, values = self.probabilities(at), self.action_values(at)
        reached, total = self.initial, 0.0
        for h in range(self.horizon):
            value = (self.probabilities(theta) * values[h]).sum(1)
            total = total - visitation_discount**h * (reached @ value)
            flow = reached[:, None] * behaviour * (1 - self.stop)
            reached = torch.einsum("sa,sat->t", flow, self.transition)
        return total

    def mean_length(self, theta):
        return -replace(self, reward=torch.ones_like(self.reward), gamma=1.0).cost(theta).item()


def random_mdp(seed, horizon=4, *, fixed_length=False, n_states=3, n_actions=2):
    rng = np.random.default_rng(seed)
    stop = rng.uniform(0.0, 0.5, (n_states, n_actions))
    return TabularMDP(
        initial=torch.from_numpy(rng.dirichlet(np.ones(n_states))),
        transition=torch.from_numpy(rng.dirichlet(np.ones(n_states), (n_states, n_actions))),
        reward=torch.from_numpy(rng.uniform(-1.0, 2.0, (n_states, n_actions))),
        stop=torch.from_numpy(np.zeros_like(stop) if fixed_length else stop),
        horizon=horizon,
    )


class TabularEnv(gym.Env):
    """A TabularMDP to simulate; ``horizon`` truncates."""

    def __init__(self, mdp):
        n_states, n_actions = mdp.reward.shape
        self.observation_space = spaces.Discrete(n_states)
        self.action_space = spaces.Discrete(n_actions)
        self._horizon = mdp.horizon
        self._initial = mdp.initial.cumsum(0).numpy()
        self._transition = mdp.transition.cumsum(2).numpy()
        self._reward, self._stop = mdp.reward.numpy(), mdp.stop.numpy()

    def _draw(self, cumulative):
        index = np.searchsorted(cumulative, self.np_random.random(), side="right")
        return min(int(index), len(cumulative) - 1)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._time, self._state = 0, self._draw(self._initial)
        return self._state, {}

    def step(self, action):
        cell = self._state, action
        self._time += 1
        self._state = self._draw(self._transition[cell])
        terminated = bool(self.np_random.random() < self._stop[cell])
        truncated = not terminated and self._time >= self._horizon
        return self._state, float(self._reward[cell]), terminated, truncated, {}


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
    """Whether the mean of independent samples [n, …] is not ``truth``, entry by entry.

    A two-sided t-test with Bonferroni's correction for the number of entries.
    """
    samples, truth = np.asarray(samples), np.asarray(truth)
    error = samples.std(0, ddof=1) / np.sqrt(len(samples))
    statistic = np.abs(samples.mean(0) - truth) / (error + 1e-12)
    return bool(statistic.max() > student.isf(level / 2 / statistic.size, len(samples) - 1))
