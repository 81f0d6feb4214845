"""The expectation of the causal Hessian estimator, by dynamic programming."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.functional import hessian, jacobian

from benchmarks.exact.mdp import TabularMDP


def expected_causal_hessian(mdp: TabularMDP, theta: Tensor, kappa: float) -> Tensor:
    r"""Return E[Σ_ij κ^|i-j| A_max(i,j) σ_i σ_jᵀ + Σ_i A_i ∇²log π_i], [d, d]; κ = 1: ∇²J.

    With A_j the cost advantage of step j and the decayed score sums u_j = Σ_{i<j} κ^{j-i} σ_i, only
    their conditional means M_j(s) = E[u_j 1{s_j = s}] are needed, which obey a linear recursion:

    .. math:: \sum_j \mathrm{E}[A_j(σ_jσ_j^T + ∇^2\log π_j)] + \sum_j \sum_s
        (M_j(s)\, \mathrm{E}_{a|s}[A_j σ_j]^T + \text{transpose}).

    A baseline of the state changes no term of it.
    """

    def log_probabilities(at: Tensor) -> Tensor:
        return mdp.probabilities(at).log()

    policy, values = mdp.probabilities(theta), mdp.values(theta)
    scores = jacobian(log_probabilities, theta)  # [S, A, d]
    curvature = torch.stack(
        [
            hessian(lambda at, cell=cell: log_probabilities(at).flatten()[cell], theta)
            for cell in range(policy.numel())
        ]
    ).view(*policy.shape, mdp.n_parameters, mdp.n_parameters)
    at_once = torch.einsum("sai,saj->saij", scores, scores) + curvature

    reached = mdp.initial
    past = torch.zeros(len(reached), mdp.n_parameters, dtype=torch.float64)
    total = torch.zeros(mdp.n_parameters, mdp.n_parameters, dtype=torch.float64)
    for h in range(mdp.horizon):
        gain = mdp.action_values(values[h + 1]) - values[h][:, None]
        weighted = -(mdp.gamma**h) * policy * gain
        crossed = past.T @ torch.einsum("sa,saj->sj", weighted, scores)
        total += torch.einsum("s,sa,saij->ij", reached, weighted, at_once) + crossed + crossed.T
        flow = policy[:, :, None] * mdp.flow  # P(a, s' | s)
        past = kappa * (
            torch.einsum("si,sat->ti", past, flow)
            + torch.einsum("s,sat,sai->ti", reached, flow, scores)
        )
        reached = torch.einsum("s,sat->t", reached, flow)
    return total
