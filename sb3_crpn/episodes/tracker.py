"""Fixed quotas of whole episodes per environment, so that no episode is kept for being short.

Taking the first m episodes to finish over parallel environments favours short ones. Here each
environment delivers its first q_e episodes, however long they take; q_e is fixed before the
rollout starts. What an environment runs beyond its quota is thrown away.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sb3_crpn.arrays import IntArray


def episodes_per_env(n_episodes: int, n_envs: int) -> IntArray:
    """Spread ``n_episodes`` over the environments as evenly as whole numbers allow, [n_envs]."""
    quotas = np.full(n_envs, n_episodes // n_envs)
    quotas[: n_episodes % n_envs] += 1
    return quotas


def steps_to_quota(n_steps: int, mean_episode_length: float | None) -> int:
    """Return the episodes per environment that should take about ``n_steps`` steps, at least 1.

    ``mean_episode_length`` is that of earlier updates (``None``: there is none yet): a function of
    the past alone, hence no bias.
    """
    if mean_episode_length is None:
        return 1
    return max(1, round(n_steps / mean_episode_length))


@dataclass(frozen=True)
class EpisodeEnd:
    """An episode of environment ``env`` that ended with the current step.

    ``start`` is the rollout step of its first transition. ``cut`` says that the horizon ended it.
    """

    env: int
    start: int
    length: int
    cut: bool


class EpisodeTracker:
    """Which steps of a rollout over parallel environments belong to which kept episode.

    An environment is *recording* an episode, *waiting* for its next one to start (it is in the
    middle of an episode that does not count), or has met its quota.

    Parameters
    ----------
    quotas
        Episodes to keep from each environment, [n_envs].
    fresh
        Whether each environment stands at an episode's first observation, [n_envs].
    horizon
        Steps after which an episode is cut; ``None``: never.
    """

    def __init__(
        self, quotas: IntArray, fresh: npt.NDArray[np.bool_], horizon: int | None = None
    ) -> None:
        self._remaining = quotas.copy()
        self._horizon = np.inf if horizon is None else horizon
        self._recording = fresh & (quotas > 0)
        self._length = np.zeros(len(quotas), dtype=np.int64)
        self._step = 0

    @property
    def complete(self) -> bool:
        """Whether every quota is met."""
        return not self._remaining.any()

    @property
    def needs_reset(self) -> bool:
        """Whether episodes are missing and none is being recorded: a reset would start them."""
        return not self.complete and not self._recording.any()

    @property
    def longest(self) -> int:
        """Steps of the longest episode being recorded."""
        return int(self._length.max())

    def advance(self, dones: npt.NDArray[np.bool_]) -> Iterator[EpisodeEnd]:
        """Take note of one step of every environment and yield the episodes that it ended."""
        self._step += 1
        self._length += self._recording
        ended = self._recording & (dones | (self._length >= self._horizon))
        for env in np.flatnonzero(ended):
            length = int(self._length[env])
            yield EpisodeEnd(int(env), self._step - length, length, cut=not dones[env])
        self._length[ended] = 0
        self._remaining -= ended
        self._recording = (self._recording & ~ended | dones) & (self._remaining > 0)

    def restart(self) -> None:
        """Take note that all environments were reset."""
        self._length[:] = 0
        self._recording = self._remaining > 0
