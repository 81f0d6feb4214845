"""Callbacks for CRPN, ACRPN and Stable-Baselines3's other on-policy algorithms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback

from sb3_crpn.algorithm import PolicyNewtonAlgorithm
from sb3_crpn.checks import FLAG, NONE, PATH, VERBOSE, integer


class RandomIterateCallback(BaseCallback):
    """Draws the iterate θ_R that convergence theorems speak of: P(R = k) ∝ α_k, k = 1, …, N.

    θ_k is the policy *after* update k and α_k the cubic term's coefficient in that update: the
    bounds hold for the point that a step leads to (:mod:`sb3_crpn.theory.recipes`). So θ_0 is never
    drawn, and θ_N may be. For algorithms other than CRPN and ACRPN, R is uniform.

    One iterate is kept, not all N: θ_k replaces it with probability α_k/Σ_{j≤k} α_j, which gives
    the same distribution (reservoir sampling; Chao, Biometrika 69, 1982). A callback that is passed
    to ``learn`` again goes on counting.

    Parameters
    ----------
    save_path
        File to save the model with θ_R's policy to when training ends, as by ``model.save``. The
        optimiser's state in it is the last one, and the statistics of ``VecNormalize`` are not.
    assign
        Leave the model itself with θ_R's policy when training ends.
    seed
        Of the callback's own generator.
    verbose
        1: print R and N when training ends.

    Raises
    ------
    ValueError
        An argument is out of range.

    Attributes
    ----------
    iteration
        R, ``None`` before the first update.
    n_iterations
        N, the updates seen.
    parameters
        The policy's ``state_dict`` at θ_R.
    """

    def __init__(
        self,
        save_path: str | Path | None = None,
        *,
        assign: bool = False,
        seed: int | None = None,
        verbose: int = 0,
    ) -> None:
        name = type(self).__name__
        super().__init__(VERBOSE(f"{name}: verbose", verbose))
        self.save_path: str | Path | None = (PATH | NONE)(f"{name}: save_path", save_path)
        self.assign: bool = FLAG(f"{name}: assign", assign)
        self.iteration: int | None = None
        self.n_iterations = 0
        self.parameters: dict[str, torch.Tensor] = {}
        self._rng = np.random.default_rng((integer(0) | NONE)(f"{name}: seed", seed))
        self._total_weight = 0.0
        self._updates_seen = 0

    def _on_training_start(self) -> None:
        self._updates_seen = self._n_updates

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self._offer()

    def _on_training_end(self) -> None:
        self._offer()
        if self.iteration is None:
            return
        if self.verbose:
            print(f"Random iterate: R = {self.iteration} of N = {self.n_iterations}")
        last = _copy(self.model.policy)
        self.model.policy.load_state_dict(self.parameters)
        try:
            if self.save_path is not None:
                Path(self.save_path).parent.mkdir(parents=True, exist_ok=True)
                self.model.save(self.save_path)
        finally:
            if not self.assign:
                self.model.policy.load_state_dict(last)

    @property
    def _n_updates(self) -> int:
        return int(self.model._n_updates)

    def _offer(self) -> None:
        """Let the current policy take the place of the kept one, if an update made it."""
        if self._n_updates == self._updates_seen:
            return
        self._updates_seen = self._n_updates
        self.n_iterations += 1
        weight = self._weight()
        self._total_weight += weight
        if self._rng.random() * self._total_weight < weight:
            self.iteration = self.n_iterations
            self.parameters = _copy(self.model.policy)

    def _weight(self) -> float:
        """Return α_k of the last update."""
        if isinstance(self.model, PolicyNewtonAlgorithm) and self.model.last_update is not None:
            return self.model.last_update.alpha
        return 1.0


def _copy(policy: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: tensor.clone() for name, tensor in policy.state_dict().items()}
