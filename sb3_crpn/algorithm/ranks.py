"""What makes the ranks of ``torch.distributed`` one training run."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

from sb3_crpn.arrays import FloatArray
from sb3_crpn.distributed import all_sum, broadcast, broadcast_state, local_mode, rank, world_size


class DistributedTraining(BaseAlgorithm):
    """Starts all ranks from rank 0's policy and statistics; rank 0 alone logs and calls back."""

    _statistics: SharedMoments | None = None

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: Any = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if world_size() > 1:
            broadcast_state(self.policy)
            normalizer = self.get_vec_normalize_env()
            # before the first reset adds to them
            self._statistics = None if normalizer is None else SharedMoments(normalizer)
        if rank() > 0:
            callback, progress_bar = None, False
            self.set_logger(Logger(folder=None, output_formats=[]))
        total_timesteps, callback = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        return total_timesteps, callback if world_size() == 1 else RankZeroCallback(callback)

    def _share_statistics(self) -> None:
        """Add up what the ranks' ``VecNormalize`` have seen since they last agreed."""
        if self._statistics is not None and world_size() > 1:
            self._statistics.merge()


class RankZeroCallback(CallbackList):
    """A callback that finds its rank alone, so that it may do all that it may on one process."""

    def __init__(self, callback: BaseCallback) -> None:
        super().__init__([callback])
        self.model = callback.model

    def on_training_start(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        """Call back, as the following methods do."""
        with local_mode():
            super().on_training_start(locals_, globals_)

    def on_rollout_start(self) -> None:
        """Call back."""
        with local_mode():
            super().on_rollout_start()

    def on_step(self) -> bool:
        """Call back."""
        with local_mode():
            return super().on_step()

    def on_rollout_end(self) -> None:
        """Call back."""
        with local_mode():
            super().on_rollout_end()

    def on_training_end(self) -> None:
        """Call back."""
        with local_mode():
            super().on_training_end()


class SharedMoments:
    """Makes the running moments of ``VecNormalize`` those of all that the ranks have seen.

    During a rollout each rank goes on from the common moments with its own observations and
    rewards; :meth:`merge` then replaces them by those of the union. With (n, μ, v) a rank's count,
    mean and variance, (n_0, μ_0, v_0) the common ones before, and sums over ranks,

        N = n_0 + Σ(n - n_0),    M = μ_0 + Σ n(μ - μ_0) / N,
        N V = S_0 + Σ(S - S_0),  S = n(v + (μ - M)²),  S_0 = n_0(v_0 + (μ_0 - M)²).

    Parameters
    ----------
    normalizer
        Of this rank; the moments of rank 0's are given to all.
    """

    def __init__(self, normalizer: VecNormalize) -> None:
        observed: Any = normalizer.obs_rms if normalizer.norm_obs else {}
        self._moments: list[RunningMeanStd] = [
            *(observed.values() if isinstance(observed, dict) else [observed]),
            normalizer.ret_rms,
        ]
        self._write(broadcast(torch.from_numpy(self._read())).numpy())

    def merge(self) -> None:
        """Replace the moments by those of the union; all ranks must call."""
        old_count, old_mean, old_variance = self._common
        count, mean, variance = self._read()
        changes = np.stack([count - old_count, count * (mean - old_mean)])
        new, shift = all_sum(torch.from_numpy(changes)).numpy()
        new_count = old_count + new
        new_mean = old_mean + shift / new_count
        old_squares = old_count * (old_variance + (old_mean - new_mean) ** 2)
        squares = count * (variance + (mean - new_mean) ** 2)
        total = old_squares + all_sum(torch.from_numpy(squares - old_squares)).numpy()
        self._write(np.stack([new_count, new_mean, total / new_count]))

    def _read(self) -> FloatArray:
        """Return count, mean and variance of every entry, [3, n]."""
        return np.concatenate(
            [
                [np.full(moment.mean.size, moment.count), moment.mean.ravel(), moment.var.ravel()]
                for moment in self._moments
            ],
            axis=1,
        )

    def _write(self, common: FloatArray) -> None:
        self._common = common
        ends = np.cumsum([moment.mean.size for moment in self._moments])
        pieces = np.split(common, ends[:-1], axis=1)
        for moment, (count, mean, variance) in zip(self._moments, pieces, strict=True):
            shape = moment.mean.shape
            moment.count = float(count[0])
            moment.mean, moment.var = mean.reshape(shape), variance.reshape(shape)
