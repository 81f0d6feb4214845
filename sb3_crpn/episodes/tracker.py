"""Which steps of a rollout belong to which segment of which trajectory.

A *trajectory* runs from an environment's reset to its end. A *segment* is a piece of one that a
rollout has seen. :class:`EpisodeTracker` keeps whole episodes alone, :class:`TimestepTracker` a
fixed number of timesteps, in segments that go on in the next rollout.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from sb3_crpn.arrays import BoolArray, IntArray
from sb3_crpn.progress import Tick


@dataclass(frozen=True)
class Segment:
    """Consecutive steps of one trajectory in environment ``env``, ended by the current step.

    Attributes
    ----------
    env, start, length
        The environment, the rollout's row of the first step, and the number of steps.
    cut
        Whether the tracker ended it: the trajectory itself goes on.
    time
        The time of the first step in its trajectory.
    trajectory
        The trajectory's number among those of the environment.
    """

    env: int
    start: int
    length: int
    cut: bool
    time: int = 0
    trajectory: int = 0


@dataclass(frozen=True)
class RolloutSize:
    """How much a rollout is to collect: ``n_steps`` per environment, or ``n_episodes`` in all."""

    n_steps: int
    n_episodes: int
    horizon: int | None = None


class Tracker(Protocol):
    """What decides when a rollout is complete, and which of its steps are learnt from.

    Attributes
    ----------
    whole_episodes
        Whether it keeps whole episodes alone. Environments are then reset before a rollout that
        begins in mid-episode, and the number of episodes follows from their last mean length.
    """

    whole_episodes: ClassVar[bool]

    def begin(self, size: RolloutSize, times: IntArray) -> None:
        """Begin a rollout; ``times``, [n_envs]: of each next step in its trajectory, from 0."""

    @property
    def complete(self) -> bool:
        """Whether the rollout has what it was to collect."""

    @property
    def needs_reset(self) -> bool:
        """Whether nothing more will come until the environments are reset."""

    @property
    def recording(self) -> BoolArray:
        """Whether the next step of each environment belongs to a segment, [n_envs]."""

    def advance(self, dones: BoolArray) -> Iterator[Segment]:
        """Take note of one step of every environment and yield the segments that it ended."""

    def restart(self) -> None:
        """Take note that all environments were reset."""


def episodes_per_env(n_episodes: int, n_envs: int) -> IntArray:
    """Spread ``n_episodes`` over the environments as evenly as whole numbers allow, [n_envs]."""
    quotas = np.full(n_envs, n_episodes // n_envs)
    quotas[: n_episodes % n_envs] += 1
    return quotas


def steps_to_quota(n_steps: int, mean_episode_length: float | None) -> int:
    """Return the episodes per environment that should take about ``n_steps`` steps, at least 1.

    ``mean_episode_length`` is that of the previous update (``None``: there is none yet): a
    function of the past alone, hence no bias.
    """
    if mean_episode_length is None:
        return 1
    return max(1, round(n_steps / mean_episode_length))


class EpisodeTracker:
    """Keeps a fixed quota of whole episodes from each environment, without length bias.

    Taking the first m episodes to finish over parallel environments favours short ones. Here each
    environment delivers its first q_e episodes, whatever their length; q_e is fixed before the
    rollout starts. Steps beyond the quota are not learnt from. An environment *records* an
    episode, *waits* for its next one to start (the present one began before the rollout, or was
    cut), or has met its quota.
    """

    whole_episodes: ClassVar[bool] = True

    def __init__(self) -> None:
        self._n_ended = np.zeros(0, dtype=np.int64)

    def begin(self, size: RolloutSize, times: IntArray) -> None:
        """Begin a rollout of ``size.n_episodes``, each cut after ``size.horizon`` steps."""
        n_envs = len(times)
        if len(self._n_ended) != n_envs:
            self._n_ended = np.zeros(n_envs, dtype=np.int64)
        self._remaining = episodes_per_env(size.n_episodes, n_envs)
        self._horizon = np.inf if size.horizon is None else size.horizon
        self._recording: BoolArray = (times == 0) & (self._remaining > 0)
        self._length = np.zeros(n_envs, dtype=np.int64)
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
    def recording(self) -> BoolArray:
        """Whether the next step of each environment belongs to a kept episode, [n_envs]."""
        return self._recording

    def advance(self, dones: BoolArray) -> Iterator[Segment]:
        """Take note of one step of every environment and yield the episodes that it ended."""
        self._step += 1
        self._length += self._recording
        ended = self._recording & (dones | (self._length >= self._horizon))
        for env in np.flatnonzero(ended):
            length, number = int(self._length[env]), int(self._n_ended[env])
            yield Segment(int(env), self._step - length, length, not dones[env], 0, number)
        self._length[ended] = 0
        self._n_ended += ended
        self._remaining -= ended
        self._recording = (self._recording & ~ended | dones) & (self._remaining > 0)

    def restart(self) -> None:
        """Take note that all environments were reset."""
        self._length[:] = 0
        self._recording = self._remaining > 0


class ProgressTracker(EpisodeTracker):
    """Tells a progress bar of each episode that it keeps."""

    def __init__(self, tick: Tick) -> None:
        super().__init__()
        self._tick = tick

    def advance(self, dones: BoolArray) -> Iterator[Segment]:
        """Take note of one step of every environment and yield the episodes that it ended."""
        for segment in super().advance(dones):
            self._tick(1)
            yield segment


class TimestepTracker:
    """Keeps ``n_steps`` steps of each environment, which goes on from where it stood.

    A trajectory that goes on in the next rollout keeps its number. ``horizon`` means nothing here.
    """

    whole_episodes: ClassVar[bool] = False

    def __init__(self) -> None:
        self._times = self._numbers = np.zeros(0, dtype=np.int64)

    def begin(self, size: RolloutSize, times: IntArray) -> None:
        """Begin a rollout of ``size.n_steps`` steps of each environment."""
        n_envs = len(times)
        if len(self._times) != n_envs:
            self._times, self._numbers = np.zeros((2, n_envs), dtype=np.int64)
        # an environment that does not stand where the last rollout left it was used elsewhere
        self._numbers = self._numbers + (times != self._times)
        self._times, self._length = times.copy(), np.zeros(n_envs, dtype=np.int64)
        self._n_steps, self._step = size.n_steps, 0

    @property
    def complete(self) -> bool:
        """Whether all steps are there."""
        return self._step >= self._n_steps

    @property
    def needs_reset(self) -> bool:
        """Never: any state will do to go on from."""
        return False

    @property
    def recording(self) -> BoolArray:
        """Every step counts, [n_envs]."""
        return np.ones(len(self._times), dtype=np.bool_)

    def advance(self, dones: BoolArray) -> Iterator[Segment]:
        """Take note of one step of every environment and yield the segments that it ended."""
        self._step += 1
        self._times += 1
        self._length += 1
        ended = np.ones_like(dones) if self.complete else dones
        for env in np.flatnonzero(ended):
            length, number = int(self._length[env]), int(self._numbers[env])
            first = int(self._times[env]) - length
            yield Segment(int(env), self._step - length, length, not dones[env], first, number)
        self._length[ended] = 0
        self._times[dones] = 0
        self._numbers += dones

    def restart(self) -> None:
        """Take note that all environments were reset."""
        self._times[:] = self._length[:] = 0
        self._numbers += 1


TRACKERS: dict[str, Callable[[], Tracker]] = {
    "episodes": EpisodeTracker,
    "timesteps": TimestepTracker,
}
