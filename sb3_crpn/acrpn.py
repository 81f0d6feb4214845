"""ACRPN: the approximate cubic-regularised policy Newton method (Maniyar et al., Algorithm 2)."""

from __future__ import annotations

from typing import Literal

import torch
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_crpn.algorithm import PolicyNewtonAlgorithm
from sb3_crpn.algorithm.declaration import configured, setting
from sb3_crpn.algorithm.solvers import ApproximateSolver, SubproblemSolver
from sb3_crpn.checks import COUNT, FLAG, NONE, POSITIVE, choice
from sb3_crpn.episodes import EpisodeBatch


@configured
class ACRPN(PolicyNewtonAlgorithm):
    """Approximate Cubic-Regularised Policy Newton: a Cauchy step or gradient descent on the model.

    Each update runs the paper's Cubic-Subsolver; where that predicts less than the decrease
    (1/100)√(ε³/ρ), ρ = α, that any point other than an ε-second-order stationary point allows, its
    Cubic-Finalsolver. With ``target_kl=None`` and the Euclidean metric they work on products with
    the whole Hessian, else on the Krylov space.

    {parameters}
    """

    gradient_lipschitz: float | Literal["auto"] = setting(
        POSITIVE | choice("auto"),
        'ℓ, a bound on ‖∇²J‖; "auto": ‖H‖, estimated in each update.',
        "auto",
    )
    sosp_epsilon: float = setting(POSITIVE, "ε > 0 of second-order stationarity.", 1e-2)
    subsolver_steps: int | None = setting(
        COUNT | NONE,
        "N̂, the maximum number of iterations of either inner gradient descent; ``None``: ℓ/√(ρε) "
        "times a logarithm, as the theory has it, up to 10,000. The paper's algorithm needs "
        "``None``.",
        50,
    )
    stop_at_sosp: bool = setting(
        FLAG,
        "End training when the predicted decrease says ε-SOSP, as the paper's Algorithm 2 does.",
        False,
    )

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Collect a rollout, unless the last update found an ε-SOSP and is to be the last."""
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
