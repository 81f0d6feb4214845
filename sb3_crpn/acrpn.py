"""ACRPN: the approximate cubic-regularised policy Newton method (Maniyar et al., Algorithm 2)."""

from __future__ import annotations

from typing import Any, Literal

import torch
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_crpn.algorithm import PolicyNewtonAlgorithm
from sb3_crpn.algorithm.arguments import (
    check_flag,
    check_integer,
    check_optional,
    check_real,
    inherits_arguments,
)
from sb3_crpn.algorithm.solvers import ApproximateSolver, SubproblemSolver
from sb3_crpn.episodes import EpisodeBatch


class ACRPN(PolicyNewtonAlgorithm):
    """Approximate Cubic-Regularised Policy Newton: a Cauchy step or gradient descent on the model.

    Each update runs the paper's Cubic-Subsolver; where that predicts less than the decrease
    (1/100)√(ε³/ρ), ρ = α, that any point other than an ε-second-order stationary point allows, its
    Cubic-Finalsolver. With ``target_kl=None`` and the Euclidean metric they work on products with
    the whole Hessian, else on the Krylov space.

    Parameters
    ----------
    gradient_lipschitz
        ℓ, a bound on ‖∇²J‖; "auto": ‖H‖, estimated in each update.
    sosp_epsilon
        ε > 0 of second-order stationarity.
    subsolver_steps
        N̂, at most so many iterations of either inner gradient descent; ``None``: ℓ/√(ρε) times a
        logarithm, as the theory has it, up to 10,000. The paper's algorithm needs ``None``.
    stop_at_sosp
        End training when the predicted decrease says ε-SOSP, as the paper's Algorithm 2 does.
    **arguments
        Those of :class:`~sb3_crpn.algorithm.PolicyNewtonAlgorithm`.
    """

    @inherits_arguments(PolicyNewtonAlgorithm)
    def __init__(
        self,
        *args: Any,
        gradient_lipschitz: float | Literal["auto"] = "auto",
        sosp_epsilon: float = 1e-2,
        subsolver_steps: int | None = 50,
        stop_at_sosp: bool = False,
        **arguments: Any,
    ) -> None:
        self.gradient_lipschitz = gradient_lipschitz
        self.sosp_epsilon = sosp_epsilon
        self.subsolver_steps = subsolver_steps
        self.stop_at_sosp = stop_at_sosp
        super().__init__(*args, **arguments)

    def _setup_model(self) -> None:
        if self.gradient_lipschitz != "auto":
            try:
                check_real("gradient_lipschitz", self.gradient_lipschitz, 0.0, open_low=True)
            except ValueError as error:
                raise ValueError(f'{error}, or "auto"') from None
        check_real("sosp_epsilon", self.sosp_epsilon, 0.0, open_low=True)
        check_optional("subsolver_steps", self.subsolver_steps, lambda n, v: check_integer(n, v, 1))
        check_flag("stop_at_sosp", self.stop_at_sosp)
        super()._setup_model()

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Collect whole episodes, unless the last update found an ε-SOSP and is to be the last."""
        if self.stop_at_sosp and self.last_update is not None and self.last_update.at_sosp:
            return False
        return super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)

    def _update_solver(self, batch: EpisodeBatch) -> SubproblemSolver:
        seed = batch.agreed(torch.tensor(self._rng.integers(2**31)))
        lipschitz = self.gradient_lipschitz
        return ApproximateSolver(
            None if isinstance(lipschitz, str) else lipschitz,
            self.sosp_epsilon,
            self.subsolver_steps,
            int(seed),
        )
