"""One Hessian and one Fisher product, relative to a gradient."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import torch

from benchmarks.common.table import Row
from benchmarks.speed.problems import SHAPES, collect, noise_model
from benchmarks.speed.timing import Task, compare
from sb3_crpn import CRPN
from sb3_crpn.algorithm import PolicyNewtonAlgorithm
from sb3_crpn.episodes import EpisodeBatch


def measure(repeats: int = 40, n_steps: int = 5000) -> list[Row]:
    """Compare the products with one gradient, a forward and a backward pass, of the same batch."""
    rows = []
    for shape in SHAPES:
        model = noise_model(CRPN, shape, n_steps)
        case = {"shape": shape, "T": n_steps, "d": len(model.actor)}
        rows.append(compare(case, product_tasks(model, collect(model)), "gradient", repeats))
    return rows


def product_tasks(model: PolicyNewtonAlgorithm, batch: EpisodeBatch) -> dict[str, Task]:
    """Return gradient, Hessian product and Fisher product, as an update computes products.

    Their graphs are kept from one product to the next, so what is timed is each further product;
    where ``max_batch_timesteps`` splits the batch, none are kept.
    """
    estimate = cache(lambda: model._estimate_from(batch))
    vector = torch.linspace(-1.0, 1.0, len(model.actor), dtype=torch.float64)
    return {
        "gradient": Task(gradient_of(model, batch)),
        "Hessian product": Task(lambda: _done(estimate().hessian @ vector)),
        "Fisher product": Task(lambda: _done(estimate().fisher @ vector)),
    }


def gradient_of(model: PolicyNewtonAlgorithm, batch: EpisodeBatch) -> Callable[[], None]:
    """Return the computation of Σ_i A_i σ_i by plain automatic differentiation."""
    pieces = [
        (
            piece.observations,
            piece.actions,
            torch.as_tensor(piece.cost_advantages, dtype=torch.float32),
        )
        for piece in batch.chunks(model.max_batch_timesteps)
    ]

    def run() -> None:
        for observations, actions, weights in pieces:
            log_prob = model.policy.get_distribution(observations).log_prob(actions)
            weights = weights.to(log_prob.device)
            model.actor.flatten(torch.autograd.grad(log_prob, model.actor.tensors, weights))

    return run


def _done(result: torch.Tensor) -> None:
    """Drop the result: a task's return value is its amount of work."""
