"""REINFORCE: the gradient step on the estimator that CRPN uses, the first-order peer."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from sb3_crpn.algorithm.arguments import check_real, check_schedule, inherits_arguments
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule

from sb3_crpn.algorithm import PolicyNewtonAlgorithm
from sb3_crpn.cubic import CubicStep
from sb3_crpn.curvature import CurvatureEstimate, LocalModel


class REINFORCE(PolicyNewtonAlgorithm):
    """θ ← θ - η g, with the gradient estimate g of the policy Newton algorithms.

    The step minimises g·s + ‖s‖²/(2η): no Hessian, no metric, no bound on the divergence. Episodes,
    advantages and critic are those of CRPN.

    Parameters
    ----------
    actor_learning_rate
        η > 0, a float or a schedule. (``learning_rate`` is the critic's, as in CRPN.)
    **arguments
        Those of :class:`~sb3_crpn.algorithm.PolicyNewtonAlgorithm` but ``alpha``, ``target_kl``,
        ``metric``, ``hessian_shrinkage`` and ``n_hessian_episodes``, which have no meaning here.
    """

    @inherits_arguments(PolicyNewtonAlgorithm)
    def __init__(
        self, *args: Any, actor_learning_rate: float | Schedule = 1e-2, **arguments: Any
    ) -> None:
        self.actor_learning_rate = actor_learning_rate
        super().__init__(
            *args, target_kl=None, metric="euclidean", hessian_shrinkage=None, **arguments
        )

    def _setup_model(self) -> None:
        positive = partial(check_real, low=0.0, open_low=True)
        check_schedule("actor_learning_rate", self.actor_learning_rate, positive)
        super()._setup_model()
        rate = FloatSchedule(self.actor_learning_rate)
        self.alpha_schedule = lambda progress: 1.0 / rate(progress)

    def _local_model(self, estimate: CurvatureEstimate) -> LocalModel:
        return LocalModel(
            gradient=estimate.gradient,
            hessian=None,
            product=torch.zeros_like,
            basis=None,
            shrinkage=0.0,
            lambda_min=float("nan"),
            products=0,
        )

    def _solve(self, model: LocalModel, alpha: float) -> CubicStep:
        """Return s = -g/α with α = 1/η."""
        step = -model.gradient / alpha
        return CubicStep(
            step=step,
            multiplier=alpha,
            predicted_decrease=-0.5 * float(model.gradient @ step),
            products=0,
            residual=0.0,
            certified=True,
            status="gradient step",
        )
