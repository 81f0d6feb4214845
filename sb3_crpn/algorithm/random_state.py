"""A saved model's random state, so that a loaded one goes on as if it had not stopped."""

from __future__ import annotations

import io
import os
import pathlib
import random
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_crpn.distributed import rank, rank_seed


class RandomState(BaseAlgorithm):
    """Saves the generators' states with the model; a continued ``learn`` restores them.

    SB3 seeds anew on loading, so that a loaded model would repeat the noise of its first steps.
    The states are restored only by ``learn(reset_num_timesteps=False)``, and only for a model
    with a seed: loading for evaluation touches nothing. The environments' own generators are
    theirs to save. With several ranks the state is rank 0's; the others, however many, go on from
    hashes of the seed, their number and the timestep.
    """

    _rng: np.random.Generator = np.random.default_rng()
    _saved_random_state: dict[str, Any] | None = None

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed Python, NumPy, PyTorch, the environments and the model's own generator.

        Every rank but the first seeds them with a hash of ``seed`` and its number.
        """
        self._seed(None if seed is None else rank_seed(seed))

    def _seed(self, seed: int | None) -> None:
        super().set_random_seed(seed)
        self._rng = np.random.default_rng(seed)

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Save all attributes, parameters and random states in a zip file; rank 0 alone does.

        A file of that name is replaced at the end, in one go: whatever happens in between leaves
        it intact.
        """
        if rank() > 0:
            return
        self._saved_random_state = {
            "python": random.getstate(),
            "numpy": np.random.get_state(),  # noqa: NPY002
            "torch": torch.get_rng_state().numpy(),
            "model": self._rng,
        }
        if self.device.type == "cuda":
            self._saved_random_state["cuda"] = torch.cuda.get_rng_state(self.device).numpy()
        try:
            if not isinstance(path, str | os.PathLike):
                super().save(path, exclude, include)
                return
            final = pathlib.Path(path)
            if not final.suffix:  # as SB3 does
                final = pathlib.Path(f"{path}.zip")
            final.parent.mkdir(parents=True, exist_ok=True)
            partial = final.with_name(f"{final.name}.partial")
            with partial.open("wb") as stream:
                super().save(stream, exclude, include)
            partial.replace(final)
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
        state, self._saved_random_state = self._saved_random_state, None
        if self.seed is None or reset_num_timesteps:
            state = None
        elif state is not None and rank() > 0:
            self._seed(rank_seed(self.seed, self.num_timesteps))
            state = None
        prepared = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        if state is not None:
            self._restore(state)
        return prepared

    def _restore(self, state: dict[str, Any]) -> None:
        random.setstate(state["python"])
        np.random.set_state(state["numpy"])  # noqa: NPY002
        torch.set_rng_state(torch.from_numpy(state["torch"]))
        if "cuda" in state and self.device.type == "cuda":
            torch.cuda.set_rng_state(torch.from_numpy(state["cuda"]), self.device)
        self._rng = state["model"]
