"""The Lipschitz constants of the theory: sup ‖∇²J‖ and sup ‖∇³J‖."""

from __future__ import annotations

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from benchmarks.exact.mdp import TabularMDP


def lipschitz_constants(mdp: TabularMDP, n_starts: int = 10, seed: int = 0) -> tuple[float, float]:
    """Return L = sup_θ ‖∇²J(θ)‖ and L_H = sup_θ ‖∇³J(θ)‖, the Lipschitz constants of ∇J and ∇²J.

    For a symmetric tensor the norm is the largest |D^k J(θ)[u, …, u]| over ‖u‖ = 1 (Banach, 1938).
    (θ, u) climb by BFGS from random starts, so that both are local maxima: lower bounds of the
    suprema, equal to them when one of the starts leads there.
    """
    rng = np.random.default_rng(seed)
    constants = []
    for order in (2, 3):
        starts = rng.normal(size=(n_starts, 2 * mdp.n_parameters))
        found = [
            minimize(_negated, start, (mdp, order, sign), jac=True).fun
            for start in starts
            for sign in (1.0, -1.0)
        ]
        constants.append(-min(found))
    return constants[0], constants[1]


def _negated(x: np.ndarray, mdp: TabularMDP, order: int, sign: float) -> tuple[float, np.ndarray]:
    """Return -sign · D^order J(θ)[u, …, u] / ‖u‖^order and its gradient, x = (θ, u)."""
    point = torch.tensor(x, requires_grad=True)
    theta, direction = point.split(mdp.n_parameters)
    along = torch.zeros((), dtype=torch.float64, requires_grad=True)
    value: Tensor = mdp.cost(theta + along * direction / direction.norm())
    for _ in range(order):
        (value,) = torch.autograd.grad(value, along, create_graph=True)
    (gradient,) = torch.autograd.grad(-sign * value, point)
    return -sign * value.item(), gradient.numpy()
