"""A batch of segments of trajectories laid end to end, and linear recursions over it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np
import torch

from sb3_crpn.arrays import BoolArray, FloatArray, IntArray, Observations
from sb3_crpn.distributed import (
    all_max,
    all_sum,
    broadcast,
    gather_counts,
    local_count,
    mean_and_variance,
    rank,
    world_size,
)
from sb3_crpn.episodes.observations import take_rows

moments = mean_and_variance  # of what is no batch yet, over all ranks


def episode_starts(lengths: IntArray) -> IntArray:
    """Return the position of each episode's first step, [E], of episodes laid end to end."""
    return np.cumsum(lengths) - lengths


def episode_time(lengths: IntArray, times: IntArray | int = 0) -> IntArray:
    """Return the time of each step in its trajectory, [T].

    ``times``, [E], is that of each segment's first step: 0 for whole episodes.
    """
    offsets: IntArray = times - episode_starts(lengths)
    time: IntArray = np.arange(lengths.sum()) + np.repeat(offsets, lengths)
    return time


@np.errstate(under="ignore")
def discount_factors(gamma: float, lengths: IntArray, times: IntArray | int = 0) -> FloatArray:
    """Return γ^i, i the time of each step in its trajectory, [T]; 0 where that underflows."""
    factors: FloatArray = np.power(gamma, episode_time(lengths, times))
    return factors


def episode_chunks(lengths: IntArray, max_steps: int) -> list[slice]:
    """Cut episodes laid end to end into runs of at most ``max_steps`` steps, or of one episode."""
    ends = np.cumsum(lengths)
    runs, start = [], 0
    while start < len(lengths):
        limit = ends[start] - lengths[start] + max_steps
        stop = max(start + 1, int(np.searchsorted(ends, limit, side="right")))
        runs.append(slice(start, stop))
        start = stop
    return runs


def round_robin_split(trajectories: IntArray, n_folds: int, first: int = 0) -> list[IntArray]:
    """Split segments into folds: the segments of one trajectory belong to one fold.

    Trajectories go to the folds in turn, beginning with fold ``first`` mod ``n_folds``, in the
    order in which they first appear. They are independent and identically distributed, so that
    any split that does not look at them is a random one.

    Parameters
    ----------
    trajectories
        The trajectory of each segment, [E].
    n_folds, first
        The number of folds, and the one that the first trajectory goes to.

    Returns
    -------
    list[IntArray]
        The segments of each fold, ascending.
    """
    _, first_seen, index = np.unique(trajectories, return_index=True, return_inverse=True)
    order = np.empty(len(first_seen), dtype=np.int64)
    order[np.argsort(first_seen)] = np.arange(len(first_seen))
    fold = (order[index] + first) % n_folds
    return [np.flatnonzero(fold == k) for k in range(n_folds)]


@np.errstate(under="ignore")  # powers of a factor: what underflows is 0
def episode_scan(
    values: FloatArray, factor: float, lengths: IntArray, *, reverse: bool = False
) -> FloatArray:
    """Solve y_i = x_i + factor · y_{i-1} within each episode, without a Python loop.

    One filter runs over all steps; what an episode inherits from the one before it decays as
    factor^(i+1) and is taken off again.

    Parameters
    ----------
    values
        x, shape [T] or [T, k], episodes end to end.
    factor
        In [0, 1].
    lengths
        Steps of each episode, [E], all positive, Σ = T.
    reverse
        Run backwards in time: y_i = x_i + factor · y_{i+1}.

    Returns
    -------
    FloatArray
        y, shape of ``values``.
    """
    if not len(values):
        return values
    if reverse:
        return episode_scan(values[::-1], factor, lengths[::-1])[::-1]
    from scipy.signal import lfilter  # here: the import takes a second

    filtered: FloatArray = lfilter([1.0], [1.0, -factor], values, axis=0)
    inherited = np.zeros((len(lengths), *filtered.shape[1:]))
    inherited[1:] = filtered[episode_starts(lengths)[1:] - 1]
    decay = discount_factors(factor, lengths, 1)
    columns = (-1, *[1] * (filtered.ndim - 1))
    own: FloatArray = filtered - decay.reshape(columns) * np.repeat(inherited, lengths, axis=0)
    return own


@dataclass(frozen=True)
class EpisodeBatch:
    """E segments of trajectories, T steps in all, laid end to end.

    A whole episode is the segment that starts at time 0 and ends by itself.

    With several ranks a batch is the union of what they hold, and each sees its own part. What is
    to be known of the union goes through this class: all ranks must then ask for it.

    Attributes
    ----------
    observations, actions
        Tensors of first dimension T (one per key for dict observations), as the policy takes them.
    lengths
        Steps of each episode, [E].
    cost_advantages
        A_i of DESIGN section 2, [T]: the cost-to-go, less a baseline; positive is bad.
    values, returns
        The critic's V(s_i) and its regression target, the λ-return, [T].
    rewards
        r_i, [T].
    log_probs
        log π(a_i|s_i) of the policy that acted, [T].
    next_observations
        The state after each segment's last step, first dimension E, as ``observations``.
    bootstrapped
        Whether the segment is bootstrapped with V of that state, [E]. After a terminal state it is
        not, and its row is 0.
    times
        The time of each segment's first step in its trajectory, [E].
    trajectories
        The number of each segment's trajectory, [E]; equal numbers are one trajectory.
    unit
        What derivatives of J are means over: whole episodes, "n_episodes", or "n_steps".
    """

    observations: Observations
    actions: torch.Tensor
    lengths: IntArray
    cost_advantages: FloatArray
    values: FloatArray
    returns: FloatArray
    rewards: FloatArray
    log_probs: FloatArray
    next_observations: Observations
    bootstrapped: BoolArray
    times: IntArray
    trajectories: IntArray
    unit: Literal["n_episodes", "n_steps"] = "n_episodes"

    @property
    def n_episodes(self) -> int:
        """E, the number of segments."""
        return len(self.lengths)

    @property
    def n_steps(self) -> int:
        """T, the number of steps."""
        return len(self.cost_advantages)

    @property
    def size(self) -> int:
        """The number of ``unit``s, by which sums over steps are divided."""
        return self.n_steps if self.unit == "n_steps" else self.n_episodes

    @property
    def n_trajectories(self) -> int:
        """The number of trajectories that the segments belong to."""
        return len(np.unique(self.trajectories))

    @property
    def total_episodes(self) -> int:
        """The number of episodes that all ranks hold; every rank must ask."""
        return sum(gather_counts(self.n_episodes))

    @property
    def total_steps(self) -> int:
        """The number of steps that all ranks hold; every rank must ask."""
        return sum(gather_counts(self.n_steps))

    @property
    def total_size(self) -> int:
        """The number of ``unit``s that all ranks hold; every rank must ask."""
        return sum(gather_counts(self.size))

    def folds(self, n_folds: int) -> list[IntArray]:
        """Return this rank's part of at most ``n_folds`` :func:`round_robin_split` folds."""
        counts = gather_counts(self.n_trajectories)
        n_folds = max(1, min(n_folds, sum(counts)))
        return round_robin_split(self.trajectories, n_folds, first=sum(counts[: rank()]))

    @property
    def is_whole(self) -> bool:
        """Whether this process holds the whole batch: a run on one process."""
        return world_size() == 1

    def share(self, n_episodes: int) -> int:
        """Return this rank's share of ``n_episodes`` that are spread evenly."""
        return local_count(n_episodes)

    def total(self, part: torch.Tensor) -> torch.Tensor:
        """Return the sum of a quantity whose ``part`` this rank's episodes make up."""
        return all_sum(part)

    def largest(self, value: float) -> float:
        """Return the largest of the ranks' values."""
        return all_max(value)

    def agreed(self, tensor: torch.Tensor) -> torch.Tensor:
        """Return the ``tensor`` of rank 0."""
        return broadcast(tensor)

    def moments(self, values: FloatArray) -> tuple[float, float]:
        """Return mean and variance over the steps of all ranks of ``values``, [T]."""
        return mean_and_variance(values)

    def take(self, episodes: IntArray) -> EpisodeBatch:
        """Return the batch of the chosen episodes, in the order given."""
        lengths = self.lengths[episodes]
        steps = np.repeat(episode_starts(self.lengths)[episodes], lengths) + episode_time(lengths)
        return self._select(episodes, steps)

    def split(self, n_folds: int) -> list[EpisodeBatch]:
        """Split this rank's trajectories into at most ``n_folds`` batches, none of them empty."""
        n_folds = min(n_folds, self.n_trajectories)
        if n_folds == 1:
            return [self]
        return [self.take(fold) for fold in round_robin_split(self.trajectories, n_folds)]

    def chunks(self, max_steps: int | None) -> list[EpisodeBatch]:
        """Cut the batch, as :func:`episode_chunks` does, into batches that share its memory."""
        if max_steps is None or self.n_steps <= max_steps:
            return [self] if self.n_episodes else []
        ends = np.append(0, np.cumsum(self.lengths))
        return [
            self._select(episodes, slice(ends[episodes.start], ends[episodes.stop]))
            for episodes in episode_chunks(self.lengths, max_steps)
        ]

    def _select(self, episodes: slice | IntArray, steps: slice | IntArray) -> EpisodeBatch:
        of_episodes = ("lengths", "bootstrapped", "times", "trajectories")
        chosen: dict[str, Any] = {
            field.name: getattr(self, field.name)[episodes if field.name in of_episodes else steps]
            for field in fields(self)
            if field.name not in ("observations", "next_observations", "unit")
        }
        return replace(
            self,
            observations=take_rows(self.observations, steps),
            next_observations=take_rows(self.next_observations, episodes),
            **chosen,
        )


def concatenate(batches: Sequence[EpisodeBatch]) -> EpisodeBatch:
    """Lay the episodes of all ``batches``, at least one, end to end."""
    if len(batches) == 1:
        return batches[0]
    joined: dict[str, Any] = {
        field.name: _join([getattr(batch, field.name) for batch in batches])
        for field in fields(EpisodeBatch)
        if field.name != "unit"
    }
    return EpisodeBatch(**joined, unit=batches[0].unit)


def _join(parts: Sequence[Any]) -> Any:
    if isinstance(parts[0], dict):
        return {key: _join([part[key] for part in parts]) for key in parts[0]}
    return torch.cat(list(parts)) if isinstance(parts[0], torch.Tensor) else np.concatenate(parts)
