"""Cross-fitting: steps evaluated on held-out episodes of the same rollout.

A rollout's episodes are dealt to K folds. For each fold a step is made from the gradient of all
*other* episodes, earlier rollouts included, in the Krylov space of that gradient, and the fold's
episodes judge it. No episode judges a step or a space that it helped to make. Only F, which has no
returns in it and so no noise of theirs, comes from the whole rollout.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from torch import Tensor

from benchmarks.experiments.steps import (
    Subspace,
    fisher_subspace,
    gradient_sums,
    hessian_sums,
    n_steps,
)
from sb3_crpn import CRPN
from sb3_crpn.curvature import HESSIAN_ESTIMATORS
from sb3_crpn.curvature.derivatives import EpisodeDerivatives
from sb3_crpn.episodes import EpisodeBatch, concatenate

N_FOLDS = 2
DIM = 10


@dataclass(frozen=True)
class Fold:
    """One fold and the other episodes, which make the step.

    Attributes
    ----------
    index
        k.
    weight
        The fold's share of the rollout's steps.
    space
        K(F, g) of the other episodes' gradient.
    gradient, test_gradient
        The others' mean over steps, and the fold's, in the space's coordinates, [n].
    """

    index: int
    weight: float
    space: Subspace
    gradient: Tensor
    test_gradient: Tensor


class CrossFit:
    """The folds of one rollout. Previous rollouts always belong to the step.

    Parameters
    ----------
    model
        Its policy, κ and ε are used.
    fresh, earlier
        The rollout, of at least two episodes, and the reweighted rollouts before it.
    n_folds
        Most folds.
    """

    def __init__(
        self,
        model: CRPN,
        fresh: EpisodeBatch,
        earlier: list[EpisodeBatch],
        n_folds: int = N_FOLDS,
    ) -> None:
        estimator = HESSIAN_ESTIMATORS.resolve(model.hessian_estimator, model)

        def derivatives(batch: EpisodeBatch) -> EpisodeDerivatives:
            return EpisodeDerivatives(model.policy, model.actor, batch, estimator)

        self._damping = model.fisher_damping
        self._fisher = [derivatives(fresh)]  # one graph: products with few steps are slow
        self._folds = [derivatives(part) for part in fresh.split(n_folds)]
        self._groups = self._folds + ([derivatives(concatenate(earlier))] if earlier else [])
        self.sizes, self.gradients = n_steps(self._groups), gradient_sums(self._groups)

    @property
    def n_folds(self) -> int:
        """K."""
        return len(self._folds)

    @property
    def fresh_gradient(self) -> Tensor:
        """The new rollout's gradient, a mean over steps, [d]."""
        return self.gradients[: self.n_folds].sum(0) / self.sizes[: self.n_folds].sum()

    def __iter__(self) -> Iterator[Fold]:
        """Iterate over the folds."""
        n_fresh = self.sizes[: self.n_folds].sum()
        for k in range(self.n_folds):
            gradient = self.gradients.sum(0) - self.gradients[k]
            gradient = gradient / (self.sizes.sum() - self.sizes[k])
            if not gradient.any():
                continue
            space = fisher_subspace(self._fisher, gradient, self._damping, DIM)
            yield Fold(
                index=k,
                weight=float(self.sizes[k] / n_fresh),
                space=space,
                gradient=space.basis.T @ gradient,
                test_gradient=space.basis.T @ self.gradients[k] / self.sizes[k],
            )

    def test_curvature(self, fold: Fold, y: Tensor) -> float:
        """Return sᵀHs of the fold's own episodes, a mean over steps."""
        step = (fold.space.basis @ y)[:, None]
        return float(hessian_sums([self._groups[fold.index]], step)) / float(self.sizes[fold.index])

    def hessian_forms(self, fold: Fold) -> Tensor:
        """Return every group's sum over steps of VᵀHV on the fold's space, [K (+ 1), n, n]."""
        return hessian_sums(self._groups, fold.space.basis)


@dataclass(frozen=True)
class Confirmation:
    """Slope and curvature along the natural-gradient step of √(sᵀFs) = 1.

    Attributes
    ----------
    claimed_slope
        -g·s on the episodes of the step.
    slope, curvature
        -g·s and sᵀHs on the held-out episodes.
    """

    claimed_slope: float
    slope: float
    curvature: float


def confirm_natural_step(folds: CrossFit) -> Confirmation:
    """Return the cross-fitted slope and curvature of the natural-gradient step."""
    claimed = slope = curvature = 0.0
    for fold in folds:
        step = -fold.gradient / fold.space.length(fold.gradient)
        claimed -= fold.weight * float(fold.gradient @ step)
        slope -= fold.weight * float(fold.test_gradient @ step)
        curvature += fold.weight * folds.test_curvature(fold, step)
    return Confirmation(claimed, slope, curvature)
