"""Tabular decision processes of finite horizon, and the derivatives of J by dynamic programming."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class TabularMDP:
    """S hidden states, O observations, A actions and H steps.

    The policy is SB3's with ``net_arch=[]`` on one-hot observations, π(·|o; θ) = softmax(We_o + b):
    θ lists the weight W [A, O] row by row, then the bias b [A]. All functions of θ are float64.

    Attributes
    ----------
    initial
        Distribution of s_0, [S].
    transition
        P(s_{h+1} | s_h, a_h), [S, A, S].
    reward
        r(s_h, a_h), [S, A].
    observation
        What is seen in each state, integers below O, [S]. Two states that look alike are aliased.
    horizon
        H; episodes take at most H steps.
    gamma
        γ in [0, 1].
    stop
        Probability that the episode ends with step h < H, of (s_h, a_h), [S, A]; ``None``: 0.
    """

    initial: Tensor
    transition: Tensor
    reward: Tensor
    observation: Tensor
    horizon: int
    gamma: float = 1.0
    stop: Tensor | None = None

    @property
    def n_observations(self) -> int:
        """O."""
        return int(self.observation.max()) + 1

    @property
    def n_actions(self) -> int:
        """A."""
        return self.reward.shape[1]

    @property
    def n_parameters(self) -> int:
        """The length of θ, d = A(O + 1)."""
        return self.n_actions * (self.n_observations + 1)

    @property
    def flow(self) -> Tensor:
        """P(s_{h+1}, the episode goes on | s_h, a_h), [S, A, S]."""
        if self.stop is None:
            return self.transition
        return (1.0 - self.stop)[..., None] * self.transition

    def probabilities(self, theta: Tensor) -> Tensor:
        """Return π(a|s; θ) for the hidden states, [S, A]."""
        weight, bias = theta.split([self.n_parameters - self.n_actions, self.n_actions])
        logits = weight.view(self.n_actions, self.n_observations).T + bias
        return torch.softmax(logits, dim=1)[self.observation]

    def values(self, theta: Tensor) -> Tensor:
        """Return V_h(s), the expected return γ^0 r_h + γ^1 r_{h+1} + … from step h, [H + 1, S]."""
        probabilities = self.probabilities(theta)
        values = [torch.zeros_like(self.initial)]
        for _ in range(self.horizon):
            values.insert(0, (probabilities * self.action_values(values[0])).sum(1))
        return torch.stack(values)

    def action_values(self, values: Tensor) -> Tensor:
        """Return Q_h(s, a) = r(s, a) + γ E[V_{h+1}(s_{h+1})] of V_{h+1} [S], [S, A]."""
        return self.reward + self.gamma * self.flow @ values

    def cost(self, theta: Tensor) -> Tensor:
        """Return J(θ) = -E[Σ_h γ^h r_h], a scalar."""
        return -(self.initial @ self.values(theta)[0])

    def gradient(self, theta: Tensor) -> Tensor:
        """Return ∇J(θ), [d]."""
        return torch.autograd.functional.jacobian(self.cost, theta)

    def hessian(self, theta: Tensor) -> Tensor:
        """Return ∇²J(θ), exactly symmetric, [d, d]."""
        hessian = torch.autograd.functional.hessian(self.cost, theta)
        return 0.5 * (hessian + hessian.T)

    def surrogate(self, theta: Tensor, behaviour: Tensor, visitation_discount: float) -> Tensor:
        r"""Return the surrogate that improves on a behaviour policy θ', a scalar.

        .. math:: -\sum_h c^h \, \mathrm{E}_{s_h \sim θ'} \sum_a π(a|s_h; θ) Q_h(s_h, a; θ')

        At θ = θ' its gradient is ∇J for c = γ, and its Hessian is not ∇²J: the terms across time
        are missing.
        """
        policy, values = self.probabilities(theta), self.values(behaviour)
        kernel = torch.einsum("sa,sat->st", self.probabilities(behaviour), self.flow)
        reached, total = self.initial, torch.zeros((), dtype=torch.float64)
        for h in range(self.horizon):
            gain = (policy * self.action_values(values[h + 1])).sum(1)
            total = total - visitation_discount**h * (reached @ gain)
            reached = reached @ kernel
        return total

    def mean_length(self, theta: Tensor) -> float:
        """Return the expected number of steps of an episode."""
        count = replace(self, reward=torch.ones_like(self.reward), gamma=1.0)
        return -count.cost(theta).item()

    def is_sosp(self, theta: Tensor, epsilon: float, rho: float) -> bool:
        """Whether ‖∇J‖ ≤ ε and λ_min(∇²J) ≥ -√(ρε): an ε-second-order stationary point."""
        if self.gradient(theta).norm() > epsilon:
            return False
        return bool(torch.linalg.eigvalsh(self.hessian(theta))[0] >= -((rho * epsilon) ** 0.5))


def coordination_mdp(gamma: float = 1.0, noise: float = 0.0) -> TabularMDP:
    r"""Two steps. The reward is +1 if the second action repeats the unobserved first, else -1.

    With z_h the difference of the two logits at step h,

    .. math:: J = -\gamma \tanh(z_0/2) \tanh(z_1/2),

    so that the uniform policy, θ = 0, is a strict saddle: J = 0, ∇J = 0, and
    ∇²J = -(γ/4)(∇z_0 ∇z_1ᵀ + ∇z_1 ∇z_0ᵀ). In θ, where ‖∇z_h‖² = 4 and ∇z_0·∇z_1 = 2 (the bias is
    shared), the eigenvalues are -3γ/2, four times 0, and γ/2; for separate logits in each
    observation they would be ±γ/2. The infimum, J = -γ, lies at infinity.

    At the saddle itself every single episode's estimate of ∇²J is exact. With ``noise`` it is
    1 ± noise times ∇²J: the second reward is raised or lowered by it, both equally likely, whatever
    is done. J is the same.
    """
    # states: the first step, then first action × sign of the noise
    reward = torch.zeros(5, 2, dtype=torch.float64)
    transition = torch.zeros(5, 2, 5, dtype=torch.float64)
    transition[1:, :, 0] = 1.0
    for action in range(2):
        after = slice(1 + 2 * action, 3 + 2 * action)
        transition[0, action, after] = 0.5
        agreement = torch.tensor([1.0, -1.0]) * (1 - 2 * action)
        reward[after] = agreement + noise * torch.tensor([[1.0], [-1.0]])
    return TabularMDP(
        initial=torch.eye(5, dtype=torch.float64)[0],
        transition=transition,
        reward=reward,
        observation=torch.tensor([0, 1, 1, 1, 1]),
        horizon=2,
        gamma=gamma,
    )


def random_mdp(
    seed: int,
    *,
    n_states: int = 4,
    n_actions: int = 2,
    n_observations: int | None = None,
    horizon: int = 5,
    gamma: float = 0.9,
    concentration: float = 1.0,
    max_stop: float = 0.0,
) -> TabularMDP:
    """Draw an MDP with rewards uniform in [-1, 1].

    Transitions are Dirichlet(``concentration``): the smaller, the more nearly deterministic. States
    are spread over the observations in turn; by default each has its own. The probabilities that
    the episode stops are uniform in [0, ``max_stop``].
    """
    rng = np.random.default_rng(seed)
    n_observations = n_states if n_observations is None else n_observations
    weights = np.full(n_states, concentration)
    mdp = TabularMDP(
        initial=torch.from_numpy(rng.dirichlet(np.ones(n_states))),
        transition=torch.from_numpy(rng.dirichlet(weights, (n_states, n_actions))),
        reward=torch.from_numpy(rng.uniform(-1.0, 1.0, (n_states, n_actions))),
        observation=torch.arange(n_states) % n_observations,
        horizon=horizon,
        gamma=gamma,
    )
    if not max_stop:
        return mdp
    return replace(mdp, stop=torch.from_numpy(rng.uniform(0.0, max_stop, (n_states, n_actions))))
