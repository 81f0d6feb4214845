"""Runs that are saved, and go on from their files as if they had not stopped."""

from __future__ import annotations

import os
import random
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from io import BufferedIOBase, BufferedWriter
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_crpn.algorithm.distributed_training import DistributedTraining
from sb3_crpn.distributed import rank, rank_seed
from sb3_crpn.episodes.observations import all_finite
from sb3_crpn.episodes.running_moments import RunningMoments

Self = TypeVar("Self", bound="ResumableAlgorithm")


class ResumableAlgorithm(OnPolicyAlgorithm):
    """An on-policy algorithm whose file holds its random states, on one rank or on several."""

    ranks: DistributedTraining  # of this call of learn

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._rng = np.random.default_rng()
        self._saved_random_state: dict[str, Any] | None = None
        if rank() > 0:
            kwargs["verbose"] = 0
        super().__init__(*args, **kwargs)

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed Python, NumPy, PyTorch, the environments and the model's own generator.

        Every rank but the first seeds them with a hash of ``seed`` and its number.
        """
        self._saved_random_state = None
        self._seed(None if seed is None else rank_seed(seed))

    def _seed(self, seed: int | None) -> None:
        super().set_random_seed(seed)
        self._rng = np.random.default_rng(seed)

    def _setup_model(self) -> None:
        pending = self._saved_random_state
        super()._setup_model()  # which seeds
        self._saved_random_state = pending

    def learn(
        self: Self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Train for at least ``total_timesteps``, as SB3's algorithms do."""
        with torch.enable_grad():
            return super().learn(
                total_timesteps=total_timesteps,
                callback=callback,
                log_interval=log_interval,
                tb_log_name=tb_log_name or type(self).__name__,
                reset_num_timesteps=reset_num_timesteps,
                progress_bar=progress_bar,
            )

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        state = self._saved_random_state
        if self.seed is None or reset_num_timesteps:
            state = None
        elif state is not None and state.get("seed", self.seed) != self.seed:
            state = None  # the file was loaded with another seed
        if rank() > 0:
            callback, progress_bar = None, False
            self.set_logger(Logger(folder=None, output_formats=[]))
            if state is not None and self.seed is not None:
                self._seed(rank_seed(self.seed, self.num_timesteps))
        normalizer = self.get_vec_normalize_env()
        self.ranks = DistributedTraining(self.policy, normalizer)
        moments = RunningMoments(normalizer)
        before = moments.snapshot()
        total_timesteps, callback = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        if not all_finite(self._last_obs):
            moments.restore(before)
        self._saved_random_state = None
        if state is not None and rank() == 0:
            load_random_state(state, self.device)
            self._rng = state["model"]
        return total_timesteps, self.ranks.callback(callback)

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        """Keep the progress of schedules in [0, 1]: whole episodes overrun the last timestep."""
        super()._update_current_progress_remaining(num_timesteps, total_timesteps)
        self._current_progress_remaining = max(0.0, self._current_progress_remaining)

    def save(
        self,
        path: str | Path | BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Save all attributes, parameters and random states in a zip file; rank 0 alone does.

        A file of that name is replaced at the end, in one go: whatever happens in between leaves
        it intact. ``learn(reset_num_timesteps=False)`` of a loaded model with a seed restores the
        random states, so that it goes on as if it had not stopped; loading for evaluation touches
        nothing. The environments' own generators are theirs to save.
        """
        if rank() > 0:
            return
        pending = self._saved_random_state  # of a file from which training has not gone on
        self._saved_random_state = pending or {
            **read_random_state(self.device),
            "model": self._rng,
            "seed": self.seed,
        }
        try:
            if not isinstance(path, str | os.PathLike):
                super().save(path, exclude, include)
                return
            file = path if Path(path).suffix else f"{path}.zip"  # as SB3 does
            with replaced_in_one_go(file) as stream:
                super().save(stream, exclude, include)
        finally:
            self._saved_random_state = pending


@contextmanager
def replaced_in_one_go(path: str | os.PathLike[str]) -> Iterator[BufferedWriter]:
    """Open a file that takes the place of ``path`` once it is complete.

    Whatever happens before leaves ``path`` intact. Its folder is made.
    """
    final = Path(path)
    final.parent.mkdir(parents=True, exist_ok=True)
    partial = final.with_name(f"{final.name}.partial")
    with partial.open("wb") as stream:
        yield stream
    partial.replace(final)


def read_random_state(device: torch.device) -> dict[str, Any]:
    """Return the states of Python's, NumPy's and PyTorch's generators."""
    state = {
        "python": random.getstate(),
        "numpy": np.random.get_state(),  # noqa: NPY002
        "torch": torch.get_rng_state().numpy(),
    }
    if device.type == "cuda":
        state["cuda"] = torch.cuda.get_rng_state(device).numpy()
    return state


def load_random_state(state: dict[str, Any], device: torch.device) -> None:
    """Set the generators to what :func:`read_random_state` returned."""
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])  # noqa: NPY002
    torch.set_rng_state(torch.from_numpy(state["torch"]))
    if "cuda" in state and device.type == "cuda":
        torch.cuda.set_rng_state(torch.from_numpy(state["cuda"]), device)
