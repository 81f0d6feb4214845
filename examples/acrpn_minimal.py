"""Algorithm 2, approximate cubic-regularised policy Newton (Maniyar et al., AISTATS 2024).

    python examples/acrpn_minimal.py

PyTorch and Gymnasium alone; episodes and Ψ are those of crpn_minimal.py. H̄_k is known by products
H̄_k[v] only. Comments that begin with "Alg. 2" quote the paper; "meant" says what it cannot mean
(docs/THEORY.md, "Errata"). A test compares an update with ``ACRPN(**PAPER)``'s.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import gymnasium as gym
import numpy as np
import torch
from crpn_minimal import Episode, cost_to_go, features, simulate, sums
from torch import Tensor
from torch.func import grad, jacrev

Product = Callable[[Tensor], Tensor]


def estimate(theta: Tensor, episodes: list[Episode], psi: list[Tensor]) -> tuple[Tensor, Product]:
    """Return ḡ_k, [d], and v ↦ H̄_k[v] of the symmetric part, without a d×d matrix."""
    grad_phi, grad_log_p = jacrev(sums)(theta, episodes, psi)  # [m, d] each
    m = len(episodes)

    def slope(at: Tensor) -> Tensor:
        return grad(lambda at: sums(at, episodes, psi)[0].mean())(at)

    def product(v: Tensor) -> Tensor:
        # Alg. 2: H̄_k = (1/b_k) Σ_τ (∇Φ ∇ᵀlog p + ∇²Φ), applied to v
        outer = grad_phi.T @ (grad_log_p @ v) + grad_log_p.T @ (grad_phi @ v)
        return outer / (2 * m) + grad(lambda at: slope(at) @ v)(theta)

    # Alg. 2: ḡ_k = (1/m_k) Σ_τ Σ_h Ψ_h(τ) ∇log π(a_h|s_h; θ_{k-1})
    return grad_phi.mean(0), product


def decrease(g: Tensor, H: Product, rho: float, delta: Tensor) -> float:
    """Return δ_J = J̄_k(θ_k + Δ) - J̄_k(θ_k), of the unperturbed model."""
    return float(g @ delta + delta @ H(delta) / 2 + rho / 6 * delta.norm() ** 3)


def subsolver(
    g: Tensor, H: Product, rho: float, ell: float, epsilon: float, n_hat: int, zeta: Tensor
) -> Tensor:
    """Return Δ of the Cubic-Subsolver; ζ is uniform on the unit sphere."""
    norm = g.norm()
    if norm >= ell**2 / rho:  # Alg. 2: if ‖ḡ‖ ≥ ℓ²/ρ
        # Alg. 2: R_c ← -ḡᵀH̄[ḡ]/(ρ‖g‖²) + √((ḡᵀH̄[ḡ_k]/(ρ‖ḡ²‖))² + 2‖g‖/ρ) (meant: ḡ, ‖ḡ‖²)
        curvature = g @ H(g) / (rho * norm**2)
        R_c = -curvature + torch.sqrt(curvature**2 + 2 * norm / rho)
        return -R_c * g / norm  # Alg. 2: Δ ← -R_c ḡ/‖g‖
    # Alg. 2: Δ ← 0, σ ← c'√(ερ)/ℓ (meant: a gradient, ε√(ρε)/ℓ), η ← 1/(20ℓ)
    delta, sigma, eta = (
        torch.zeros_like(g),
        epsilon * math.sqrt(rho * epsilon) / ell,
        1 / (20 * ell),
    )
    perturbed = g + sigma * zeta  # Alg. 2: g̃ ← ḡ + σζ
    for _ in range(n_hat):  # Alg. 2: for k = 0 to N̂
        # Alg. 2: Δ ← Δ - η(g̃ + H̄[Δ] + (ρ/2)‖Δ‖Δ)
        delta = delta - eta * (perturbed + H(delta) + rho / 2 * delta.norm() * delta)
    return delta


def finalsolver(g: Tensor, H: Product, rho: float, ell: float, epsilon: float) -> Tensor:
    """Return Δ of the Cubic-Finalsolver."""
    # Alg. 2: Δ ← 0, ḡ_J ← ḡ, η ← 1/(20ℓ)
    delta, slope, eta = torch.zeros_like(g), g, 1 / (20 * ell)
    while slope.norm() >= epsilon / 2:  # Alg. 2: while ‖ḡ_J‖ ≥ ε/2
        delta = delta - eta * slope  # Alg. 2: Δ ← Δ - η ḡ_J
        # Alg. 2: ḡ_J ← ḡ_J + H̄[Δ] + (ρ/2)‖Δ‖Δ (meant: ḡ in place of the second ḡ_J)
        slope = g + H(delta) + rho / 2 * delta.norm() * delta
    return delta


def main(n_bar: int = 100, m: int = 50, rho: float = 300.0, gamma: float = 0.99) -> None:
    """Learn CartPole-v1 with ε = 0.1, ℓ = 400, N̂ = 100 and the baseline of crpn_minimal.py."""
    epsilon, ell, n_hat = 0.1, 400.0, 100
    env, rng, generator = gym.make("CartPole-v1"), np.random.default_rng(0), torch.manual_seed(0)
    theta, V = torch.zeros(10, dtype=torch.float64), torch.zeros(9, dtype=torch.float64)
    for k in range(
        1, n_bar + 1
    ):  # Alg. 2: for k = 0 to N̄ (meant: 1, for θ_{k-1}, θ_k ← θ_{k-1} + Δ)
        episodes = [simulate(env, theta, rng) for _ in range(m)]
        costs = [cost_to_go(episode.rewards, gamma) for episode in episodes]
        discounts = [gamma ** torch.arange(len(cost)) for cost in costs]
        x = [features(episode) for episode in episodes]
        psi = [c + d * (phi @ V) for c, d, phi in zip(costs, discounts, x, strict=True)]
        g, H = estimate(theta, episodes, psi)
        zeta = torch.randn(len(theta), generator=generator, dtype=theta.dtype)
        delta = subsolver(g, H, rho, ell, epsilon, n_hat, zeta / zeta.norm())
        # Alg. 2: if δ_J ≥ -(1/100)√(ε³/ρ), then θ* ← θ_k + Δ of the Finalsolver (meant: and end)
        at_sosp = decrease(g, H, rho, delta) >= -math.sqrt(epsilon**3 / rho) / 100
        theta = theta + (finalsolver(g, H, rho, ell, epsilon) if at_sosp else delta)
        returns = torch.cat([-c / d for c, d in zip(costs, discounts, strict=True)])
        V = torch.linalg.lstsq(torch.cat(x), returns[:, None]).solution[:, 0]
        print(f"update {k}: mean return {sum(map(len, costs)) / m:.1f}", flush=True)
        if at_sosp:
            break


if __name__ == "__main__":
    main()
