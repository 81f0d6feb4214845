"""Algorithm 1, cubic-regularised policy Newton (Maniyar et al., AISTATS 2024), in one file.

    python examples/crpn_minimal.py

PyTorch and Gymnasium alone; comments that begin with "Alg. 1" quote the paper. The policy is
softmax-linear, θ = (W, b). J is a cost, c = -r. A test compares an update with ``CRPN(**PAPER)``'s.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor
from torch.func import grad, jacrev


class Episode(NamedTuple):
    """A trajectory τ: observations [T, O], actions [T] and rewards [T]."""

    observations: Tensor
    actions: Tensor
    rewards: Tensor


def split(theta: Any, n_observations: int) -> tuple[Any, Any]:
    """Return W [A, O] and b [A], of which θ holds W row by row, then b."""
    n_actions = len(theta) // (n_observations + 1)
    return theta[:-n_actions].reshape(n_actions, n_observations), theta[-n_actions:]


def simulate(env: gym.Env[Any, Any], theta: Tensor, rng: np.random.Generator) -> Episode:
    """Run one whole episode according to θ."""
    observation, _ = env.reset(seed=int(rng.integers(2**31)))
    weight, bias = split(theta.numpy(), observation.size)
    steps, over = [], False
    while not over:
        action = np.argmax(weight @ observation + bias + rng.gumbel(size=bias.size))  # ~ π(·|s; θ)
        following, reward, terminated, truncated, _ = env.step(action)
        steps.append((observation.astype(float), action, float(reward)))
        observation, over = following, terminated or truncated
    return Episode(*(torch.from_numpy(np.array(part)) for part in zip(*steps, strict=True)))


def cost_to_go(rewards: Tensor, gamma: float) -> Tensor:
    """Return Ψ_i(τ) = Σ_{h≥i} γ^h c_h, [T]; the paper's γ^{h-1} divides J by γ."""
    costs = -rewards * gamma ** torch.arange(len(rewards))
    return costs.flip(0).cumsum(0).flip(0)


def sums(theta: Tensor, episodes: list[Episode], psi: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Return Φ(θ; τ) = Σ_h Ψ_h(τ) log π(a_h|s_h; θ) and Σ_h log π(a_h|s_h; θ), [m] each."""
    observations, actions = (torch.cat(part) for part in list(zip(*episodes, strict=True))[:2])
    weight, bias = split(theta, observations.shape[1])
    log_pi = torch.log_softmax(observations @ weight.T + bias, 1)[range(len(actions)), actions]
    parts = torch.split(log_pi, [len(part) for part in psi])
    phi = [part @ weights for part, weights in zip(parts, psi, strict=True)]
    return torch.stack(phi), torch.stack([part.sum() for part in parts])


def estimate(theta: Tensor, episodes: list[Episode], psi: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Return ḡ_k, [d], and the symmetric part of H̄_k, [d, d]: the argmin sees no other."""
    grad_phi, grad_log_p = jacrev(sums)(theta, episodes, psi)  # [m, d] each
    # Alg. 1: ḡ_k = (1/m_k) Σ_τ Σ_h Ψ_h(τ) ∇log π(a_h|s_h; θ_{k-1})
    g = grad_phi.mean(0)
    # Alg. 1: H̄_k = (1/b_k) Σ_τ (Σ_h Ψ_h(τ) ∇log π(a_h|s_h; θ_{k-1}) Σ_h' ∇ᵀlog π(a_h'|s_h'; …))
    #               + (1/b_k) Σ_τ Σ_h Ψ_h(τ) ∇²log π(a_h|s_h; θ_{k-1})
    curvature = jacrev(grad(lambda at: sums(at, episodes, psi)[0].mean()))(theta)
    H = grad_phi.T @ grad_log_p / len(episodes) + curvature
    return g, (H + H.T) / 2


def cubic_step(g: Tensor, H: Tensor, alpha: float) -> Tensor:
    """Return argmin_s g·s + ½ sᵀHs + (α/6)‖s‖³: (H + λI)s = -g, λ = α‖s‖/2, H + λI ⪰ 0."""
    eigenvalues, Q = torch.linalg.eigh(H)
    c, least = Q.T @ g, max(0.0, -float(eigenvalues[0]))  # λ ≥ least
    # λ - least lies between
    low, high = 1e-15 * least + 1e-300, (alpha * float(g.norm()) / 2) ** 0.5
    s = -c / (eigenvalues + least + low)
    if float(s.norm()) < 2 * least / alpha:  # the hard case: g ⊥ the leftmost eigenvector
        s[0] = ((2 * least / alpha) ** 2 - float(s[1:].norm()) ** 2) ** 0.5
        return Q @ s
    for _ in range(200):  # ‖(H + λI)⁻¹g‖ falls and 2λ/α rises with λ
        middle = (low + high) / 2
        s = -c / (eigenvalues + least + middle)
        too_long = float(s.norm()) > 2 * (least + middle) / alpha
        low, high = (middle, high) if too_long else (low, middle)
    return Q @ s


def features(episode: Episode) -> Tensor:
    """Return 1, s and s² for a linear baseline V(s), which Algorithm 1 has not."""
    s = episode.observations
    return torch.cat([torch.ones(len(s), 1, dtype=s.dtype), s, s**2], dim=1)


def main(n_updates: int = 100, m: int = 50, alpha: float = 300.0, gamma: float = 0.99) -> None:
    """Learn CartPole-v1. A baseline of earlier episodes leaves ḡ_k and H̄_k unbiased."""
    env, rng = gym.make("CartPole-v1"), np.random.default_rng(0)
    theta, V = torch.zeros(10, dtype=torch.float64), torch.zeros(9, dtype=torch.float64)
    for k in range(1, n_updates + 1):  # Alg. 1: for k = 1, …, N
        # Alg. 1: simulate min{m_k, b_k} trajectories according to θ_{k-1} (meant: max; m = b)
        episodes = [simulate(env, theta, rng) for _ in range(m)]
        costs = [cost_to_go(episode.rewards, gamma) for episode in episodes]
        discounts = [gamma ** torch.arange(len(cost)) for cost in costs]
        x = [features(episode) for episode in episodes]
        psi = [c + d * (phi @ V) for c, d, phi in zip(costs, discounts, x, strict=True)]
        g, H = estimate(theta, episodes, psi)
        theta = theta + cubic_step(g, H, alpha)  # Alg. 1: θ_k = argmin_θ J̃^k(θ)
        returns = torch.cat([-c / d for c, d in zip(costs, discounts, strict=True)])
        V = torch.linalg.lstsq(torch.cat(x), returns[:, None]).solution[:, 0]
        print(f"update {k}: mean return {sum(map(len, costs)) / m:.1f}", flush=True)


if __name__ == "__main__":
    main()
