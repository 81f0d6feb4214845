"""The actor's step: choose α, try the step, accept it or restore the parameters."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from sb3_crpn.algorithm.evaluation import CandidateEvaluator, StepEvaluation
from sb3_crpn.algorithm.kl_control import fit_alpha
from sb3_crpn.algorithm.solvers import SubproblemSolver
from sb3_crpn.cubic import CubicStep
from sb3_crpn.curvature import LocalModel


@dataclass(frozen=True, eq=False)
class PolicyStep:
    """A step that was tried on the actor.

    Attributes
    ----------
    alpha
        α of the cubic term.
    cubic
        The minimiser of the cubic model, in the model's coordinates.
    step
        s, [d].
    evaluation
        The step's effect on the batch.
    """

    alpha: float
    cubic: CubicStep
    step: torch.Tensor
    evaluation: StepEvaluation

    @property
    def kl(self) -> float:
        """The mean KL divergence from the old policy."""
        return self.evaluation.kl

    def acceptable(self, target_kl: float | None) -> bool:
        """Whether the actor may stay at the step.

        The new policy must be finite: all that the paper asks. With a target it must also keep it,
        and must not raise the importance-weighted surrogate cost.
        """
        if target_kl is None:
            return self.evaluation.finite
        return (
            self.evaluation.finite
            and self.kl <= target_kl
            and self.evaluation.surrogate_change <= 0.0
        )


def take_step(
    evaluator: CandidateEvaluator,
    model: LocalModel,
    solver: SubproblemSolver,
    alpha: float,
    target_kl: float | None,
) -> tuple[PolicyStep, bool]:
    """Move the actor by the minimiser of the cubic model, and back if the step is no good.

    Parameters
    ----------
    evaluator
        Moves the actor from θ, and restores it bit for bit.
    model
        The cubic model around θ.
    solver
        Minimises the model.
    alpha
        α, or the first guess of it with ``target_kl``.
    target_kl
        Mean KL divergence to keep by the choice of α; ``None``: no bound.

    Returns
    -------
    tuple[PolicyStep, bool]
        The step, and whether the actor was moved by it.
    """

    def attempt(alpha: float) -> PolicyStep:
        cubic = solver.solve(model, alpha)
        step = evaluator.batch.agreed(model.to_parameters(cubic.step))
        return PolicyStep(alpha, cubic, step, evaluator.evaluate(step))

    trial = attempt(alpha) if target_kl is None else fit_alpha(attempt, alpha, target_kl)
    accepted = trial.acceptable(target_kl)
    if accepted:
        evaluator.move(trial.step)  # the last trial may have been another
    else:
        evaluator.restore()
    return trial, accepted
