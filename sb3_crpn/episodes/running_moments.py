"""The running moments of ``VecNormalize``, read and written as one."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeAlias

from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_crpn.arrays import FloatArray

Moments: TypeAlias = list[tuple[float, FloatArray, FloatArray]]


class RunningMoments:
    """Counts, means and variances that a ``VecNormalize`` keeps of observations and returns.

    Without one (``None``) there are no moments.
    """

    def __init__(self, normalizer: VecNormalize | None) -> None:
        self._normalizer = normalizer
        self._moments: list[RunningMeanStd] = []
        if normalizer is not None:
            observed: Any = normalizer.obs_rms if normalizer.norm_obs else {}
            observations = observed.values() if isinstance(observed, dict) else [observed]
            self._moments = [*observations, normalizer.ret_rms]

    @property
    def reward_unit(self) -> float:
        """What rewards are divided by, √(Var[Σγ^h r_h] + ε); 1 where they are not normalised."""
        normalizer = self._normalizer
        if normalizer is None or not normalizer.norm_reward:
            return 1.0
        return math.sqrt(float(normalizer.ret_rms.var) + normalizer.epsilon)

    def raw_rewards(self, rewards: FloatArray) -> FloatArray:
        """Return the last step's rewards as they were before ``VecNormalize`` scaled them."""
        if self._normalizer is None or not self._normalizer.norm_reward:
            return rewards
        return self._normalizer.get_original_reward()

    def read(self) -> Moments:
        """Return (count, mean, variance) of each."""
        # by reference: SB3 replaces the arrays, and never writes them
        return [(moment.count, moment.mean, moment.var) for moment in self._moments]

    def write(self, values: Moments) -> None:
        """Set what :meth:`read` returned."""
        for moment, (count, mean, variance) in zip(self._moments, values, strict=True):
            moment.count, moment.mean, moment.var = count, mean, variance

    def snapshot(self) -> tuple[Moments, FloatArray | None]:
        """Return all that a step changes, discounted returns included, for :meth:`restore`."""
        returns = None if self._normalizer is None else self._normalizer.returns.copy()
        return self.read(), returns

    def restore(self, snapshot: tuple[Moments, FloatArray | None]) -> None:
        """Undo the steps since the snapshot."""
        moments, returns = snapshot
        self.write(moments)
        if self._normalizer is not None and returns is not None:
            self._normalizer.returns = returns


@contextmanager
def frozen_moments(env: VecEnv) -> Iterator[None]:
    """Let a ``VecNormalize`` around the environments learn nothing from the block's steps."""
    normalizer = unwrap_vec_normalize(env)
    if normalizer is None:
        yield
        return
    learns, normalizer.training = normalizer.training, False
    try:
        yield
    finally:
        normalizer.training = learns
