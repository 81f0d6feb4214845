"""ACRPN: the approximate cubic-regularised policy Newton method (Maniyar et al., Algorithm 2)."""

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_crpn.algorithm import PolicyNewtonAlgorithm
from sb3_crpn.algorithm.declaration import configured, setting
from sb3_crpn.checks import COUNT, FLAG, NONE, POSITIVE, choice
from sb3_crpn.cubic import CubicStep, cubic_finalsolver, cubic_subsolver
from sb3_crpn.curvature import CurvatureEstimate, LocalModel
from sb3_crpn.distributed import broadcast


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
    _at_sosp = False

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        self._at_sosp = False
        return super()._setup_learn(*args, **kwargs)

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Collect whole episodes, unless the last update found an ε-SOSP and is to be the last."""
        if self.stop_at_sosp and bool(broadcast(torch.tensor(self._at_sosp))):
            return False
        return super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)

    def _local_model(self, estimate: CurvatureEstimate) -> LocalModel:
        # one perturbation an update, whatever α is tried
        self._perturbation_seed = int(broadcast(torch.tensor(self._rng.integers(2**31))))
        return super()._local_model(estimate)

    def _solve(self, model: LocalModel, alpha: float) -> CubicStep:
        lipschitz = self._lipschitz(model)
        cubic = cubic_subsolver(
            model.gradient,
            model.product,
            alpha,
            gradient_lipschitz=lipschitz,
            epsilon=self.sosp_epsilon,
            max_steps=self.subsolver_steps,
            seed=self._perturbation_seed,
        )
        enough = math.sqrt(self.sosp_epsilon**3 / alpha) / 100.0
        self._at_sosp = cubic.predicted_decrease <= enough
        if not self._at_sosp:
            return cubic
        return cubic_finalsolver(
            model.gradient,
            model.product,
            alpha,
            gradient_lipschitz=lipschitz,
            epsilon=self.sosp_epsilon,
            max_steps=self.subsolver_steps,
        )

    def _lipschitz(self, model: LocalModel) -> float | None:
        if self.gradient_lipschitz != "auto":
            return self.gradient_lipschitz
        # None: the subsolver estimates it by products
        return None if model.hessian is None else float(torch.linalg.matrix_norm(model.hessian, 2))
