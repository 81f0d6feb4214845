"""The running moments of ``VecNormalize``, read and written as one."""

from __future__ import annotations

from typing import Any, TypeAlias

from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

from sb3_crpn.arrays import FloatArray

Moments: TypeAlias = list[tuple[float, FloatArray, FloatArray]]


class RunningMoments:
    """Counts, means and variances that a ``VecNormalize`` keeps of observations and returns."""

    def __init__(self, normalizer: VecNormalize) -> None:
        observed: Any = normalizer.obs_rms if normalizer.norm_obs else {}
        self._normalizer = normalizer
        self._moments: list[RunningMeanStd] = [
            *(observed.values() if isinstance(observed, dict) else [observed]),
            normalizer.ret_rms,
        ]

    def read(self) -> Moments:
        """Return (count, mean, variance) of each."""
        # by reference: SB3 replaces the arrays, and never writes them
        return [(moment.count, moment.mean, moment.var) for moment in self._moments]

    def write(self, values: Moments) -> None:
        """Set what :meth:`read` returned."""
        for moment, (count, mean, variance) in zip(self._moments, values, strict=True):
            moment.count, moment.mean, moment.var = count, mean, variance

    def snapshot(self) -> tuple[Moments, FloatArray]:
        """Return all that a step changes, discounted returns included, for :meth:`restore`."""
        return self.read(), self._normalizer.returns.copy()

    def restore(self, snapshot: tuple[Moments, FloatArray]) -> None:
        """Undo the steps since the snapshot."""
        moments, self._normalizer.returns = snapshot
        self.write(moments)
