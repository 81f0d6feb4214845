"""Small decision processes with exactly known J(θ), ∇J(θ) and ∇²J(θ), and their simulation."""

from benchmarks.exact.causal import expected_causal_hessian
from benchmarks.exact.env import TabularEnv, TabularVectorEnv
from benchmarks.exact.lipschitz import lipschitz_constants
from benchmarks.exact.mdp import TabularMDP, coordination_mdp, random_mdp
from benchmarks.exact.policy import actor_vector, assign_actor

__all__ = [
    "TabularEnv",
    "TabularMDP",
    "TabularVectorEnv",
    "actor_vector",
    "assign_actor",
    "coordination_mdp",
    "expected_causal_hessian",
    "lipschitz_constants",
    "random_mdp",
]
