"""The actor's step: choose α, try the step, accept it or restore the parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from sb3_crpn.algorithm.evaluation import CandidateEvaluator, StepEvaluation, fit_alpha
from sb3_crpn.cubic import CubicStep
from sb3_crpn.curvature import LocalModel


@dataclass(frozen=True)
class PolicyStep:
    """What an update did to the actor.

    Attributes
    ----------
    cubic
        The minimiser of the cubic model, in the model's coordinates.
    norm
        ‖s‖, the Euclidean length of the step in ℝᵈ.
    alpha
        α of the cubic term.
    trial
        The step's effect on the batch.
    rejected
        Whether the actor was put back.
    """

    cubic: CubicStep
    norm: float
    alpha: float
    trial: StepEvaluation
    rejected: bool

    def log(self) -> dict[str, float]:
        """Return the step's log entries; a rejected step has moved nothing."""
        moved = not self.rejected
        return {
            "alpha": self.alpha,
            "multiplier": self.cubic.multiplier,
            "predicted_decrease": self.cubic.predicted_decrease,
            "step_norm": self.norm if moved else 0.0,
            "kl_divergence": self.trial.kl if moved else 0.0,
            "surrogate_change": self.trial.surrogate_change if moved else 0.0,
            "step_rejected": int(self.rejected),
        }


def take_step(
    tester: CandidateEvaluator,
    model: LocalModel,
    solve: Callable[[float], CubicStep],
    alpha: float,
    target_kl: float | None,
) -> PolicyStep:
    """Move the actor by the minimiser of the cubic model, and back if the step is no good.

    Without ``target_kl``, α is as given and only a policy that is not finite is rejected: the
    paper's algorithms. With it, α is fitted to it, and a step is also rejected that violates the
    target or raises the importance-weighted surrogate cost.

    Parameters
    ----------
    tester
        Moves the actor from θ, and restores it bit for bit.
    model
        The cubic model around θ.
    solve
        α ↦ minimiser of the model.
    alpha
        α, or the first guess of it.
    target_kl
        Mean KL divergence to keep; ``None``: no bound.
    """

    def attempt(alpha: float) -> tuple[CubicStep, torch.Tensor, StepEvaluation]:
        cubic = solve(alpha)
        step = model.to_parameters(cubic.step)
        return cubic, step, tester.evaluate(step)

    try:
        if target_kl is not None:
            alpha = fit_alpha(lambda alpha: attempt(alpha)[2].kl, alpha, target_kl)
        cubic, step, trial = attempt(alpha)
    except BaseException:  # Ctrl-C included: never leave the actor at a trial step
        tester.restore()
        raise
    rejected = not trial.finite
    if target_kl is not None:
        rejected = rejected or trial.kl > target_kl or trial.surrogate_change > 0.0
    if rejected:
        tester.restore()
    return PolicyStep(cubic, float(step.norm()), alpha, trial, rejected)
