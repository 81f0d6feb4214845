"""REINFORCE: the gradient step on the estimator that CRPN uses, the first-order peer."""

from __future__ import annotations

from stable_baselines3.common.type_aliases import Schedule

from sb3_crpn.algorithm import PolicyNewtonAlgorithm
from sb3_crpn.algorithm.declaration import configured, setting
from sb3_crpn.algorithm.settings import CheckedSchedule, checked_schedule
from sb3_crpn.algorithm.solvers import SubproblemSolver
from sb3_crpn.checks import NONE, POSITIVE, SCHEDULE, choice, real
from sb3_crpn.cubic import CubicStep
from sb3_crpn.curvature import LocalModel
from sb3_crpn.episodes import EpisodeBatch


class GradientStep:
    """s = -g/α, α = 1/η."""

    def needs_matrix(self, dim: int) -> bool:
        """Return False."""
        return False

    def solve(self, model: LocalModel, alpha: float) -> CubicStep:
        """Minimise g·s + (α/2)‖s‖²."""
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


@configured
class REINFORCE(PolicyNewtonAlgorithm):
    """θ ← θ - η g, with the gradient estimate g of the policy Newton algorithms.

    The step minimises g·s + ‖s‖²/(2η): no Hessian, no metric, no bound on the divergence. Episodes,
    advantages and critic are those of CRPN.

    {parameters}
    """

    actor_learning_rate: float | Schedule = setting(
        POSITIVE | SCHEDULE,
        "η > 0, a float or a schedule. (``learning_rate`` is the critic's, as in CRPN.)",
        1e-2,
    )
    target_kl: None = setting(NONE, "Not used.", None)
    metric: str = setting(choice("euclidean"), "Not used.", "euclidean")
    hessian_shrinkage: float = setting(real(0.0, 0.0), "No Hessian.", 0.0)

    def _setup_model(self) -> None:
        super()._setup_model()
        rate = checked_schedule(self, "actor_learning_rate", POSITIVE)
        self.alpha_schedule = CheckedSchedule(
            f"{type(self).__name__}: 1/actor_learning_rate",
            lambda progress: 1.0 / rate(progress),
            POSITIVE,
        )

    def _update_solver(self, batch: EpisodeBatch) -> SubproblemSolver:
        return GradientStep()
