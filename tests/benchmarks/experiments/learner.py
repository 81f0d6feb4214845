"""A learner on a decision process whose derivatives are known."""

import torch
from torch.autograd.functional import jacobian

from benchmarks.exact import TabularVectorEnv, assign_actor, expected_causal_hessian, random_mdp
from benchmarks.experiments.steps import Subspace
from sb3_crpn import CRPN, PAPER
from sb3_crpn.vec_env import GymnasiumVecEnv

KAPPA = 0.9
MDP = random_mdp(0)
THETA = torch.linspace(-1.0, 1.0, MDP.n_parameters, dtype=torch.float64)
# The gradient's expectation is ∇J, the Hessian's `expected_causal_hessian`
UNBIASED = PAPER | {
    "target_kl": 0.02,
    "metric": "fisher",
    "hessian_estimator": "causal",
    "hessian_lambda": KAPPA,
    "policy_kwargs": {"net_arch": []},
}


def make_learner(algorithm=CRPN, n_envs=8, **arguments):
    env = GymnasiumVecEnv(TabularVectorEnv(MDP, n_envs))
    settings = UNBIASED | {"n_steps": MDP.horizon, "gamma": MDP.gamma, "seed": 0} | arguments
    model = algorithm("MlpPolicy", env, device="cpu", **settings)
    assign_actor(model.policy, THETA)
    return model


def exact_derivatives():
    """∇J, E[H] and F, means over steps: [d], [d, d], [d, d]."""
    gradient = MDP.gradient(THETA) / MDP.horizon
    hessian = expected_causal_hessian(MDP, THETA, KAPPA) / MDP.horizon
    policy = MDP.probabilities(THETA)
    scores = jacobian(lambda theta: MDP.probabilities(theta).log(), THETA)
    reached, fisher = MDP.initial, 0.0
    for _ in range(MDP.horizon):
        fisher = fisher + torch.einsum("s,sa,sai,saj->ij", reached, policy, scores, scores)
        reached = torch.einsum("s,sa,sat->t", reached, policy, MDP.transition)
    return gradient, hessian, fisher / MDP.horizon


def exact_model():
    """All of ℝᵈ in coordinates where F + εI is I, with ∇J and E[H] in them."""
    gradient, hessian, fisher = exact_derivatives()
    eigenvalues, vectors = torch.linalg.eigh(fisher)
    eigenvalues = eigenvalues.clamp(min=0.0)
    metric = eigenvalues + 0.1
    space = Subspace(vectors / metric.sqrt(), eigenvalues / metric)
    return space, space.basis.T @ gradient, space.basis.T @ hessian @ space.basis
