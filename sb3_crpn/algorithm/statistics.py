"""What an update did, as a typed record and as log entries."""

from __future__ import annotations

from dataclasses import dataclass

from stable_baselines3.common.logger import Logger


@dataclass(frozen=True)
class UpdateStats:
    """The statistics of one update, ``model.last_update``.

    J, advantages and returns are in the units of the rewards that the algorithm sees; advantages
    may be normalised. A rejected step has moved nothing: its length and its effects are 0.

    Attributes
    ----------
    n_updates
        Updates so far, this one included.
    gradient_norm
        ‖g‖, Euclidean.
    gradient_noise
        Estimate of E‖g - ∇J‖² / ‖g‖²; nan from one episode.
    alpha
        α of the step's cubic term.
    multiplier
        λ = α‖s‖_M/2, in the units of H relative to M.
    predicted_decrease
        m(0) - m(s) of the cubic model, in the units of J.
    step_norm
        ‖s‖, Euclidean.
    kl
        Mean KL(old ‖ new) over states and action components, in nats.
    surrogate_change
        (1/m) Σ_i A_i (π_new/π_old - 1), a cost: negative is an improvement.
    policy_objective
        TRPO's: the mean over steps of -A_i π_new/π_old. Positive is good.
    accepted
        Whether the step was taken.
    n_trials
        Steps that were tried to choose α.
    certified
        Whether the solver verified that s is a global minimiser of the model.
    solver_status
        How the solver ended, for people.
    at_sosp
        Whether ACRPN's solver found θ to be an ε-second-order stationary point.
    lambda_min
        Leftmost eigenvalue of H relative to M that the model or the solver saw; nan if none.
    hessian_vector_products
        Products with H, or with the metric's generator, spent on the update.
    hessian_shrinkage
        ω.
    n_episodes
        Fresh episodes of all ranks.
    n_reused_rollouts
        Earlier rollouts that joined the update.
    used_timesteps_fraction
        Part of the simulated timesteps that belong to whole episodes.
    explained_variance
        1 - Var[R - V] / Var[R] over the fresh steps; nan where Var[R] = 0.
    target_kl
        The scaled target of this update; ``None``: α follows its schedule.
    value_loss
        Mean squared error of the critic during its fit; ``None``: V is not used.
    std
        Mean standard deviation of the actions; ``None``: the policy has no ``log_std``.
    """

    n_updates: int
    gradient_norm: float
    gradient_noise: float
    alpha: float
    multiplier: float
    predicted_decrease: float
    step_norm: float
    kl: float
    surrogate_change: float
    policy_objective: float
    accepted: bool
    n_trials: int
    certified: bool
    solver_status: str
    at_sosp: bool
    lambda_min: float
    hessian_vector_products: int
    hessian_shrinkage: float
    n_episodes: int
    n_reused_rollouts: int
    used_timesteps_fraction: float
    explained_variance: float
    target_kl: float | None
    value_loss: float | None
    std: float | None

    @property
    def rejected(self) -> bool:
        """Whether the actor was put back."""
        return not self.accepted

    def write(self, logger: Logger) -> None:
        """Record every entry of ``LOG_KEYS`` that the update has."""
        for key, field in LOG_KEYS.items():
            value = getattr(self, field)
            if value is not None:
                value = int(value) if isinstance(value, bool) else value
                exclude = "tensorboard" if key in NOT_IN_TENSORBOARD else None
                logger.record(f"train/{key}", value, exclude=exclude)


# Log key below train/ → field. Keys in the last block are those of sb3-contrib's TRPO.
LOG_KEYS = {
    "gradient_norm": "gradient_norm",
    "gradient_noise": "gradient_noise",
    "alpha": "alpha",
    "multiplier": "multiplier",
    "predicted_decrease": "predicted_decrease",
    "step_norm": "step_norm",
    "kl_divergence": "kl",
    "surrogate_change": "surrogate_change",
    "step_rejected": "rejected",
    "n_trials": "n_trials",
    "certified": "certified",
    "solver_status": "solver_status",
    "lambda_min": "lambda_min",
    "hessian_vector_products": "hessian_vector_products",
    "hessian_shrinkage": "hessian_shrinkage",
    "n_episodes": "n_episodes",
    "n_reused_rollouts": "n_reused_rollouts",
    "used_timesteps_fraction": "used_timesteps_fraction",
    "target_kl": "target_kl",
    "explained_variance": "explained_variance",
    "value_loss": "value_loss",
    "std": "std",
    "n_updates": "n_updates",
    "kl_divergence_loss": "kl",
    "policy_objective": "policy_objective",
    "is_line_search_success": "accepted",
}
NOT_IN_TENSORBOARD = {"solver_status", "n_updates"}
