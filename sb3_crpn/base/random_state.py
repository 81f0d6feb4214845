"""A saved model's random state, so that a loaded one goes on as if it had not stopped."""

from __future__ import annotations

import io
import pathlib
import random
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback


class RandomState(BaseAlgorithm):
    """Saves the generators' states with the model; a continued ``learn`` restores them.

    SB3 seeds anew on loading, so that a loaded model would repeat the noise of its first steps.
    The states are restored only by ``learn(reset_num_timesteps=False)``, and only for a model
    with a seed: loading for evaluation touches nothing. The environments' own generators are
    theirs to save.
    """

    _rng: np.random.Generator = np.random.default_rng()
    _saved_random_state: dict[str, Any] | None = None

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed Python, NumPy, PyTorch, the environments and the model's own generator."""
        super().set_random_seed(seed)
        self._rng = np.random.default_rng(seed)

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Save all attributes, parameters and random states in a zip file."""
        self._saved_random_state = {
            "python": random.getstate(),
            "numpy": np.random.get_state(),  # noqa: NPY002
            "torch": torch.get_rng_state().numpy(),
            "model": self._rng,
        }
        try:
            super().save(path, exclude, include)
        finally:
            self._saved_random_state = None

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: Any = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        prepared = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        state, self._saved_random_state = self._saved_random_state, None
        if state is not None and self.seed is not None and not reset_num_timesteps:
            random.setstate(state["python"])
            np.random.set_state(state["numpy"])  # noqa: NPY002
            torch.set_rng_state(torch.from_numpy(state["torch"]))
            self._rng = state["model"]
        return prepared
