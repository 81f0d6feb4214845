"""What makes the ranks of ``torch.distributed`` one training run."""

from __future__ import annotations

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecNormalize

from sb3_crpn.arrays import FloatArray
from sb3_crpn.distributed import all_sum, broadcast, broadcast_state, local_mode, world_size
from sb3_crpn.episodes.running_moments import RunningMoments


class DistributedTraining:
    """The communication of one call of ``learn``; on one process there is none.

    All ranks start from rank 0's policy and statistics. Rank 0 alone logs, calls back and saves.

    Parameters
    ----------
    policy
        Gets the bits of rank 0's.
    normalizer
        The environment's ``VecNormalize``, before its first reset; ``None``: there is none.
    """

    def __init__(self, policy: BasePolicy, normalizer: VecNormalize | None) -> None:
        self._moments = None
        if world_size() > 1:
            broadcast_state(policy)
            if normalizer is not None:
                self._moments = SharedMoments(normalizer)

    def callback(self, callback: BaseCallback) -> BaseCallback:
        """Return the callback of this rank."""
        return callback if world_size() == 1 else RankZeroCallback(callback)

    def totals(self, *counts: float) -> list[float]:
        """Return the sums of the ranks' counts, and merge what their ``VecNormalize`` have seen."""
        totals: list[float] = all_sum(torch.tensor(counts, dtype=torch.float64)).tolist()
        if self._moments is not None and world_size() > 1:
            self._moments.merge()
        return totals


def share_policy(policy: BasePolicy) -> None:
    """Give every rank the policy of rank 0, bit for bit."""
    broadcast_state(policy)


class RankZeroCallback(CallbackList):
    """A callback that finds its rank alone, so that it may do all that it may on one process."""

    def __init__(self, callback: BaseCallback) -> None:
        super().__init__([callback])
        self.model = callback.model

    on_training_start = local_mode()(CallbackList.on_training_start)
    on_rollout_start = local_mode()(CallbackList.on_rollout_start)
    on_step = local_mode()(CallbackList.on_step)
    on_rollout_end = local_mode()(CallbackList.on_rollout_end)
    on_training_end = local_mode()(CallbackList.on_training_end)


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
        self._moments = RunningMoments(normalizer)
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
                [np.full(np.size(mean), count), np.ravel(mean), np.ravel(variance)]
                for count, mean, variance in self._moments.read()
            ],
            axis=1,
        )

    def _write(self, common: FloatArray) -> None:
        self._common = common
        shapes = [np.shape(mean) for _, mean, _ in self._moments.read()]
        ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
        pieces = np.split(common, ends[:-1], axis=1)
        self._moments.write(
            [
                (float(count[0]), mean.reshape(shape), variance.reshape(shape))
                for shape, (count, mean, variance) in zip(shapes, pieces, strict=True)
            ]
        )
