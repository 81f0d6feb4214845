"""What second order costs: products against gradients, and solves, as ratios inside one run.

python -m benchmarks.speed
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_crpn.cubic import solve_dense, solve_krylov
from sb3_crpn.curvature import PairWeights
from sb3_crpn.curvature.scores import EpisodeGroup, policy_distribution
from sb3_crpn.episodes import EpisodeBatch
from sb3_crpn.parameters import ActorParameters

REPEATS = 20


def interleaved(functions: dict[str, Callable[[], object]]) -> dict[str, list[float]]:
    """Return the seconds of each function's calls, run in turn so that drift hits all alike."""
    seconds: dict[str, list[float]] = {name: [] for name in functions}
    for repeat in range(REPEATS + 2):
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            if repeat >= 2:  # warm-up
                seconds[name].append(time.perf_counter() - start)
    return seconds


def frozen_episodes(
    n_observations: int, action_space: spaces.Space, n_steps: int, n_episodes: int = 10
) -> tuple[ActorCriticPolicy, ActorParameters, EpisodeBatch]:
    """Return a 64×64 MLP policy and random episodes of it."""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    space = spaces.Box(-1, 1, (n_observations,), np.float32)
    policy = ActorCriticPolicy(space, action_space, lambda _: 1e-3)
    observations = torch.as_tensor(rng.normal(size=(n_steps, n_observations)), dtype=torch.float32)
    distribution = policy.get_distribution(observations)
    actions = distribution.sample().detach()
    actor = ActorParameters.reachable(policy, distribution.log_prob(actions))
    batch = EpisodeBatch(
        observations=observations,
        actions=actions,
        lengths=np.full(n_episodes, n_steps // n_episodes),
        weights=rng.normal(size=n_steps),
        values=np.zeros(n_steps),
        returns=np.zeros(n_steps),
    )
    return policy, actor, batch


def products() -> None:
    """Print one Hessian and one Fisher product as multiples of one gradient."""
    print("| T | d | gradient, ms | Hessian product / gradient | Fisher product / gradient |")
    print("|---|---|---|---|---|")
    for n_observations, action_space in (
        (4, spaces.Discrete(2)),  # CartPole-v1
        (348, spaces.Box(-1, 1, (17,), np.float32)),  # Humanoid-v5
    ):
        policy, actor, batch = frozen_episodes(n_observations, action_space, 5000)
        group = EpisodeGroup(policy, actor, batch, PairWeights("causal", 0.9))
        weights = torch.as_tensor(batch.weights, dtype=torch.float32)
        vector = torch.randn(len(actor), dtype=torch.float64)

        def gradient(policy=policy, actor=actor, batch=batch, weights=weights) -> object:  # type: ignore
            log_prob = policy_distribution(policy, batch).log_prob(batch.actions)
            return actor.flatten(torch.autograd.grad(log_prob, actor.tensors, weights))

        seconds = interleaved(
            {
                "gradient": gradient,
                "hessian": lambda group=group, v=vector: group.hessian_product(v),
                "fisher": lambda group=group, v=vector: group.fisher_product(v),
            }
        )
        unit = statistics.median(seconds["gradient"])
        ratios = [
            _with_quartiles([b / a for a, b in zip(seconds["gradient"], seconds[k], strict=True)])
            for k in ("hessian", "fisher")
        ]
        cells = f"{batch.n_steps} | {len(actor)} | {1e3 * unit:.1f} | {' | '.join(ratios)}"
        print(f"| {cells} |")


def solves() -> None:
    """Print the time and the products of solves of random problems with decaying spectra."""
    print("\n| d | dense, ms | krylov, ms | krylov products | certified |")
    print("|---|---|---|---|---|")
    for d in (10, 1000, 4610):
        generator = torch.Generator().manual_seed(0)
        Q, _ = torch.linalg.qr(torch.randn(d, d, dtype=torch.float64, generator=generator))
        eigenvalues = torch.randn(d, dtype=torch.float64, generator=generator)
        eigenvalues /= torch.arange(1, d + 1) ** 0.5
        H = (Q * eigenvalues) @ Q.T
        H = 0.5 * (H + H.T)
        g = torch.randn(d, dtype=torch.float64, generator=generator) / d**0.5
        start = time.perf_counter()
        if d <= 2000:
            solve_dense(g, H, 1.0)
            dense = f"{1e3 * (time.perf_counter() - start):.1f}"
        else:
            dense = "-"
        start = time.perf_counter()
        step = solve_krylov(g, lambda v, H=H: H @ v, 1.0)
        elapsed = 1e3 * (time.perf_counter() - start)
        print(f"| {d} | {dense} | {elapsed:.1f} | {step.products} | {step.certified} |")


def _with_quartiles(values: list[float]) -> str:
    low, middle, high = statistics.quantiles(values, n=4)
    return f"{middle:.2f} [{low:.2f}, {high:.2f}]"


if __name__ == "__main__":
    torch.set_num_threads(1)
    products()
    solves()
