"""What an update did, as a typed record and as log entries."""

from __future__ import annotations

from dataclasses import dataclass, fields

from stable_baselines3.common.logger import Logger


@dataclass(frozen=True)
class UpdateStats:
    """The statistics of one update, ``model.last_update``; each is logged under its name.

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
    kl_divergence
        Mean KL(old ‖ new) over states and action components, in nats.
    surrogate_change
        (1/m) Σ_i A_i (π_new/π_old - 1), a cost: negative is an improvement. m counts episodes;
        with rollouts of timesteps, steps.
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
    confirmed_lambda_min
        The curvature along such an eigenvector in episodes that did not choose it; nan where the
        model is not a subspace's, and from one episode.
    hessian_vector_products
        Products with H, or with the metric's generator, spent on the update.
    hessian_shrinkage
        ω.
    mean_reward
        Mean reward of a fresh step, in the environment's own units: the learning curve of a task
        that never ends.
    n_episodes
        Fresh episodes of all ranks; with rollouts of timesteps, segments of trajectories.
    n_reused_rollouts
        Earlier rollouts that joined the update.
    used_timesteps_fraction
        Part of the simulated timesteps that are learnt from.
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
    kl_divergence: float
    surrogate_change: float
    policy_objective: float
    accepted: bool
    n_trials: int
    certified: bool
    solver_status: str
    at_sosp: bool
    lambda_min: float
    confirmed_lambda_min: float
    hessian_vector_products: int
    hessian_shrinkage: float
    mean_reward: float
    n_episodes: int
    n_reused_rollouts: int
    used_timesteps_fraction: float
    explained_variance: float
    target_kl: float | None
    value_loss: float | None
    std: float | None

    @property
    def step_rejected(self) -> bool:
        """Whether the actor was put back."""
        return not self.accepted

    def write(self, logger: Logger) -> None:
        """Record the fields that the update has, and the entries of ``LOG_KEYS``, below train/."""
        names = {field.name: field.name for field in fields(self) if field.name not in NOT_LOGGED}
        for key, name in (names | LOG_KEYS).items():
            value = getattr(self, name)
            if value is not None:
                value = int(value) if isinstance(value, bool) else value
                exclude = "tensorboard" if key in NOT_IN_TENSORBOARD else None
                logger.record(f"train/{key}", value, exclude=exclude)


# Log keys that are no fields; the last two are those of sb3-contrib's TRPO
LOG_KEYS = {
    "step_rejected": "step_rejected",
    "kl_divergence_loss": "kl_divergence",
    "is_line_search_success": "accepted",
}
NOT_LOGGED = {"accepted", "at_sosp"}
NOT_IN_TENSORBOARD = {"solver_status", "n_updates"}
