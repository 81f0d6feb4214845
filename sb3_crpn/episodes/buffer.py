"""SB3's rollout buffer, holding whole episodes of whatever length."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import DictRolloutBufferSamples, RolloutBufferSamples

from sb3_crpn.arrays import Array, IntArray
from sb3_crpn.distributed import all_sum
from sb3_crpn.episodes.advantages import cost_advantages, generalized_advantages
from sb3_crpn.episodes.batch import EpisodeBatch, Observations, episode_time
from sb3_crpn.episodes.tracker import EpisodeEnd

# Steps in one forward pass that evaluates: enough to be efficient, of bounded memory
CHUNK = 4096

_ARRAYS = ("actions", "rewards", "returns", "episode_starts", "values", "log_probs", "advantages")


class EpisodeRolloutBuffer(RolloutBuffer):
    """A rollout buffer that grows, and knows which of its steps make up the kept episodes.

    The arrays are SB3's, [capacity, n_envs, …], of which the first ``pos`` rows are filled;
    ``buffer_size`` is the initial capacity and doubles whenever it is met. Steps outside the kept
    episodes stay in the arrays and are never read again.
    """

    def reset(self) -> None:
        """Forget all steps and episodes; the capacity stays."""
        super().reset()
        self._ends: list[EpisodeEnd] = []
        self._terminal_values: list[float] = []

    def add(self, *args: Any, **kwargs: Any) -> None:
        """Store one step of every environment, as :meth:`RolloutBuffer.add` does."""
        if self.pos == self.buffer_size:
            self._grow()
        super().add(*args, **kwargs)

    def _grow(self) -> None:
        for name in _ARRAYS:
            setattr(self, name, _doubled(getattr(self, name)))
        if isinstance(self.observations, dict):
            for key, array in self.observations.items():
                self.observations[key] = _doubled(array)
        else:
            self.observations = _doubled(self.observations)
        self.buffer_size *= 2

    def close_episode(self, end: EpisodeEnd, terminal_value: float) -> None:
        """Keep an episode that ended with the step just added.

        ``terminal_value`` is V of the state after it, 0 unless a time limit's value is
        bootstrapped.
        """
        self._ends.append(end)
        self._terminal_values.append(terminal_value)

    @property
    def lengths(self) -> IntArray:
        """Steps of each kept episode, [E]."""
        return np.array([end.length for end in self._ends], dtype=np.int64)

    @property
    def used_fraction(self) -> float:
        """Share of the steps simulated by all ranks that belong to kept episodes."""
        steps = torch.tensor([self.lengths.sum(), self.pos * self.n_envs], dtype=torch.float64)
        kept, simulated = all_sum(steps).tolist()
        return float(kept / simulated)

    def _kept_steps(self) -> tuple[IntArray, IntArray]:
        """Return the (row, environment) of every kept step, episodes end to end."""
        lengths = self.lengths
        starts = np.array([end.start for end in self._ends], dtype=np.int64)
        envs = np.array([end.env for end in self._ends], dtype=np.int64)
        return np.repeat(starts, lengths) + episode_time(lengths), np.repeat(envs, lengths)

    def evaluate(self, policy: ActorCriticPolicy) -> None:
        """Fill ``values`` and ``log_probs`` of the kept steps from the policy that acted.

        SB3 asks for both at every step of a rollout; asking once spares most of that time.
        """
        rows, envs = self._kept_steps()
        for start in range(0, len(rows), CHUNK):
            kept = rows[start : start + CHUNK], envs[start : start + CHUNK]
            with torch.no_grad():
                values, log_probs, _ = policy.evaluate_actions(
                    self._gather_observations(kept),
                    self._gather_actions(kept),
                )
            self.values[kept] = values.flatten().cpu().numpy()
            self.log_probs[kept] = log_probs.cpu().numpy()

    def compute_advantages(self) -> None:
        """Fill ``advantages`` with GAE(λ) and ``returns`` with the λ-return of each kept step."""
        kept = self._kept_steps()
        values = self.values[kept].astype(np.float64)
        advantages = generalized_advantages(
            self.rewards[kept].astype(np.float64),
            values,
            np.array(self._terminal_values),
            self.lengths,
            self.gamma,
            self.gae_lambda,
        )
        self.advantages[kept] = advantages
        self.returns[kept] = advantages + values

    def episode_batch(
        self, *, baseline: bool, normalize_advantage: bool, discount_visitation: bool
    ) -> EpisodeBatch:
        """Return the kept episodes with the weights of :func:`cost_advantages`.

        Â is the advantage, or the λ-return where ``baseline`` is false.
        """
        kept = self._kept_steps()
        lengths = self.lengths
        weights = cost_advantages(
            (self.advantages if baseline else self.returns)[kept].astype(np.float64),
            lengths,
            gamma=self.gamma,
            normalize_advantage=normalize_advantage,
            discount_visitation=discount_visitation,
        )
        return EpisodeBatch(
            observations=self._gather_observations(kept),
            actions=self._gather_actions(kept),
            lengths=lengths,
            cost_advantages=weights,
            values=self.values[kept].astype(np.float64),
            returns=self.returns[kept].astype(np.float64),
            rewards=self.rewards[kept].astype(np.float64),
            log_probs=self.log_probs[kept].astype(np.float64),
            terminal_values=np.array(self._terminal_values),
        )

    def _gather_observations(self, kept: tuple[IntArray, IntArray]) -> Observations:
        if isinstance(self.observations, dict):
            return {key: self.to_torch(array[kept]) for key, array in self.observations.items()}
        return self.to_torch(self.observations[kept])

    def _gather_actions(self, kept: tuple[IntArray, IntArray]) -> torch.Tensor:
        actions = self.to_torch(self.actions[kept].astype(np.float32, copy=False))
        if isinstance(self.action_space, spaces.Discrete):
            return actions.long().flatten()
        return actions

    def get(self, batch_size: int | None = None) -> Generator[Any, None, None]:
        """Yield the kept steps once, in random minibatches, as SB3's buffers do."""
        rows, envs = self._kept_steps()
        order = np.random.permutation(len(rows))  # noqa: NPY002 the generator of SB3's buffers
        size = len(rows) if batch_size is None else batch_size
        for start in range(0, len(rows), size):
            chosen = order[start : start + size]
            yield self._samples((rows[chosen], envs[chosen]))

    def _samples(
        self, kept: tuple[IntArray, IntArray]
    ) -> RolloutBufferSamples | DictRolloutBufferSamples:
        actions = self.to_torch(self.actions[kept].astype(np.float32, copy=False))
        arrays = (self.values, self.log_probs, self.advantages, self.returns)
        observations = self._gather_observations(kept)
        rest = (actions, *(self.to_torch(array[kept]) for array in arrays))
        if isinstance(observations, dict):
            return DictRolloutBufferSamples(observations, *rest)
        return RolloutBufferSamples(observations, *rest)


class DictEpisodeRolloutBuffer(EpisodeRolloutBuffer, DictRolloutBuffer):
    """:class:`EpisodeRolloutBuffer` for dict observations."""


def _doubled(array: Array) -> Array:
    """Return ``array`` followed by as many rows again."""
    return np.concatenate([array, np.zeros_like(array)])
