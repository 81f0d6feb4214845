"""Models that learn a tabular MDP from a fixed number of whole episodes an update."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sb3_contrib import TRPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from torch import Tensor

from benchmarks.exact import TabularMDP, TabularVectorEnv, actor_vector, assign_actor
from benchmarks.reinforce import REINFORCE
from sb3_crpn import ACRPN, CRPN, PAPER
from sb3_crpn.vec_env import GymnasiumVecEnv

# PAPER without the arguments of the Hessian, for REINFORCE
PAPER_GRADIENT = {
    key: value
    for key, value in PAPER.items()
    if key not in ("target_kl", "metric", "hessian_estimator", "hessian_shrinkage")
}
ALGORITHMS: dict[str, tuple[type[OnPolicyAlgorithm], dict[str, Any]]] = {
    "CRPN, paper": (CRPN, PAPER),
    # d = 6: the Krylov space is all of ℝᵈ that the batch sees, and its products are cheap
    "ACRPN, paper": (ACRPN, PAPER | {"subsolver_steps": None, "krylov_dim": 6}),
    "CRPN": (CRPN, {}),
    "ACRPN": (ACRPN, {}),
    "REINFORCE": (REINFORCE, PAPER_GRADIENT),
    "A2C": (A2C, {}),
    "PPO": (PPO, {}),
    "TRPO": (TRPO, {}),
}


def make_learner(
    algorithm: str, mdp: TabularMDP, batch: int, theta: Tensor, seed: int, **arguments: Any
) -> OnPolicyAlgorithm:
    """Return a softmax-linear learner at ``theta`` that simulates ``batch`` episodes an update.

    They run side by side, one in each of ``batch`` parallel environments, for every algorithm.
    """
    algorithm_class, settings = ALGORITHMS[algorithm]
    model: Any = algorithm_class(
        "MlpPolicy",  # type: ignore[arg-type]
        GymnasiumVecEnv(TabularVectorEnv(mdp, batch)),
        n_steps=mdp.horizon,
        gamma=mdp.gamma,
        policy_kwargs={"net_arch": []},
        seed=seed,
        device="cpu",
        **settings | arguments,
    )
    assign_actor(model.policy, theta)
    return model


class UntilExactly(BaseCallback):
    """Stops once θ meets a condition. θ is checked before the first update and after each.

    Parameters
    ----------
    condition
        Of θ, [d] float64: exact, no episode is spent on it.
    max_updates
        The cap.

    Attributes
    ----------
    n_updates
        Updates made.
    met
        Whether the condition was met.
    theta
        The last θ.
    """

    def __init__(self, condition: Callable[[Tensor], bool], max_updates: int) -> None:
        super().__init__()
        self._condition, self._max_updates = condition, max_updates
        self.n_updates, self.met = -1, False

    def _on_rollout_start(self) -> None:
        self.n_updates += 1
        self.theta = actor_vector(self.model.policy)
        self.met = self._condition(self.theta)

    def _on_step(self) -> bool:
        return not self.met and self.n_updates < self._max_updates


def run_until(
    model: OnPolicyAlgorithm, condition: Callable[[Tensor], bool], max_updates: int
) -> UntilExactly:
    """Train until ``condition`` holds for θ, or for ``max_updates`` updates."""
    until = UntilExactly(condition, max_updates)
    # only the first step of the stopped rollout is beyond the updates
    model.learn(10**12, callback=until)
    return until
