"""SB3's rollout buffer, holding whole episodes of whatever length."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import DictRolloutBufferSamples, RolloutBufferSamples

from sb3_crpn.arrays import Array, BoolArray, FloatArray, IntArray, Observations
from sb3_crpn.episodes.advantages import cost_advantages, generalized_advantages
from sb3_crpn.episodes.batch import EpisodeBatch, episode_time
from sb3_crpn.episodes.observations import take_rows
from sb3_crpn.episodes.tracker import Segment
from sb3_crpn.policy import state_values, to_tensor, values_and_log_probs

# Steps in one forward pass that evaluates: enough to be efficient, of bounded memory
CHUNK = 4096

_ARRAYS = ("actions", "rewards", "returns", "episode_starts", "values", "log_probs", "advantages")


class EpisodeRolloutBuffer(RolloutBuffer):
    """A rollout buffer that grows, and knows the segments of trajectories that its steps make up.

    The arrays are SB3's, [rows, n_envs, …]. During a rollout their capacity doubles whenever it is
    met; :meth:`finish` cuts them to what was collected. Steps outside the segments (of episodes
    beyond an environment's quota) stay in the arrays with SB3's own estimates, and are not learnt
    from.
    """

    def reset(self) -> None:
        """Forget all steps and segments; the capacity stays."""
        super().reset()
        self._segments: list[Segment] = []
        self._next_observations: list[Any] = []
        self._terminal_values: FloatArray = np.zeros(0)
        self._float64_advantages: FloatArray = np.zeros(0)

    def add(self, *args: Any, **kwargs: Any) -> None:
        """Store one step of every environment, as :meth:`RolloutBuffer.add` does."""
        if self.pos == self.buffer_size:
            self._resize(lambda array: np.concatenate([array, np.zeros_like(array)]))
        super().add(*args, **kwargs)

    def _resize(self, change: Callable[[Array], Array]) -> None:
        for name in _ARRAYS:
            setattr(self, name, change(getattr(self, name)))
        if isinstance(self.observations, dict):
            for key, array in self.observations.items():
                self.observations[key] = change(array)
        else:
            self.observations = change(self.observations)
        self.buffer_size = len(self.rewards)

    def close(self, segment: Segment, next_observation: Any = None) -> None:
        """Keep a segment that ended with the step just added.

        ``next_observation`` is the state after it, whose value it is bootstrapped with; ``None``
        after a terminal state.
        """
        self._segments.append(segment)
        self._next_observations.append(next_observation)

    def finish(self, policy: ActorCriticPolicy | None, last_observations: Any) -> None:
        """Cut the arrays to the steps collected, and estimate values and advantages.

        V and log π are asked for once a rollout, where SB3 asks at every step.

        Parameters
        ----------
        policy
            The policy that acted; ``None`` where V is not used: V = 0, and log π is not needed.
        last_observations
            The environments' observations after the last step.
        """
        self._resize(lambda array: array[: self.pos])
        self.full = True
        valid = self._valid_steps()
        if policy is not None:
            self._evaluate(policy, *valid)
        self._terminal_values = bootstrap_values(policy, self._next_rows(), self._bootstrapped)
        if len(valid[0]) < self.rewards.size:
            self._estimate_all(policy, last_observations, valid)
        self._compute_advantages(*valid)

    @property
    def lengths(self) -> IntArray:
        """Steps of each segment, [E]."""
        return self._of_segments("length")

    def _of_segments(self, name: str) -> IntArray:
        return np.array([getattr(segment, name) for segment in self._segments], dtype=np.int64)

    def _valid_steps(self) -> tuple[IntArray, IntArray]:
        """Return the (row, environment) of every segment's steps, segments end to end."""
        lengths = self.lengths
        starts, envs = self._of_segments("start"), self._of_segments("env")
        return np.repeat(starts, lengths) + episode_time(lengths), np.repeat(envs, lengths)

    def _evaluate(self, policy: ActorCriticPolicy, rows: IntArray, envs: IntArray) -> None:
        """Fill ``values`` and ``log_probs`` of the steps given."""
        for start in range(0, len(rows), CHUNK):
            steps = rows[start : start + CHUNK], envs[start : start + CHUNK]
            values, log_probs = values_and_log_probs(
                policy, self._gather_observations(steps), self._gather_actions(steps)
            )
            self.values[steps] = values.cpu().numpy()
            self.log_probs[steps] = log_probs.cpu().numpy()

    @property
    def _bootstrapped(self) -> BoolArray:
        """Whether each segment is bootstrapped with V of the state after it, [E]."""
        return np.array([obs is not None for obs in self._next_observations], dtype=np.bool_)

    def _estimate_all(
        self,
        policy: ActorCriticPolicy | None,
        last_observations: Any,
        valid: tuple[IntArray, IntArray],
    ) -> None:
        """Fill the other steps' values, returns and advantages as SB3 does: callbacks read them."""
        others = np.ones(self.rewards.shape, dtype=np.bool_)
        others[valid] = False
        last_values = np.zeros(self.n_envs)
        if policy is not None:
            self._evaluate(policy, *np.nonzero(others))
            last_values = values_of(policy, last_observations)
        self.compute_returns_and_advantage(torch.as_tensor(last_values), np.zeros(self.n_envs))

    def _compute_advantages(self, rows: IntArray, envs: IntArray) -> None:
        """Fill ``advantages`` with GAE(λ) and ``returns`` with the λ-return of each valid step."""
        valid = rows, envs
        values = self.values[valid].astype(np.float64)
        self._float64_advantages = generalized_advantages(
            self.rewards[valid].astype(np.float64),
            values,
            self._terminal_values,
            self.lengths,
            self.gamma,
            self.gae_lambda,
        )
        self.advantages[valid] = self._float64_advantages
        self.returns[valid] = self._float64_advantages + values

    def episode_batch(
        self, *, baseline: bool, normalize_advantage: bool, discount_visitation: bool
    ) -> EpisodeBatch:
        """Return the segments with the cost advantages of :func:`cost_advantages`.

        Â is the advantage, or the λ-return where ``baseline`` is false.
        """
        valid = self._valid_steps()
        values = self.values[valid].astype(np.float64)
        returns = self._float64_advantages + values
        times = self._of_segments("time")
        return EpisodeBatch(
            observations=self._gather_observations(valid),
            actions=self._gather_actions(valid),
            lengths=self.lengths,
            cost_advantages=cost_advantages(
                self._float64_advantages if baseline else returns,
                self.lengths,
                times,
                gamma=self.gamma,
                normalize_advantage=normalize_advantage,
                discount_visitation=discount_visitation,
            ),
            values=values,
            returns=returns,
            rewards=self.rewards[valid].astype(np.float64),
            log_probs=self.log_probs[valid].astype(np.float64),
            next_observations=self._next_rows(),
            bootstrapped=self._bootstrapped,
            times=times,
            trajectories=self._of_segments("trajectory") * self.n_envs + self._of_segments("env"),
        )

    def _next_rows(self) -> Observations:
        """Return the state after each segment as observations are stored, [E, …]; 0 for none."""
        stored = self.observations
        if isinstance(stored, dict):
            return {
                key: self._next_of(array, [obs and obs[key] for obs in self._next_observations])
                for key, array in stored.items()
            }
        return self._next_of(stored, self._next_observations)

    def _next_of(self, stored: Array, observations: list[Any]) -> torch.Tensor:
        rows = np.zeros((len(observations), *stored.shape[2:]), dtype=stored.dtype)
        for row, observation in zip(rows, observations, strict=True):
            if observation is not None:
                row[...] = np.reshape(observation, row.shape)
        return self.to_torch(rows)

    def _gather_observations(self, steps: tuple[IntArray, IntArray]) -> Observations:
        if isinstance(self.observations, dict):
            return {key: self.to_torch(array[steps]) for key, array in self.observations.items()}
        return self.to_torch(self.observations[steps])

    def _gather_actions(self, steps: tuple[IntArray, IntArray]) -> torch.Tensor:
        actions = self.to_torch(self.actions[steps].astype(np.float32, copy=False))
        if isinstance(self.action_space, spaces.Discrete):
            return actions.long().flatten()
        return actions

    def get(self, batch_size: int | None = None) -> Generator[Any, None, None]:
        """Yield the valid steps once, in random minibatches, as SB3's buffers do."""
        rows, envs = self._valid_steps()
        order = np.random.permutation(len(rows))  # noqa: NPY002 the generator of SB3's buffers
        size = len(rows) if batch_size is None else batch_size
        for start in range(0, len(rows), size):
            chosen = order[start : start + size]
            yield self._samples((rows[chosen], envs[chosen]))

    def _samples(
        self, steps: tuple[IntArray, IntArray]
    ) -> RolloutBufferSamples | DictRolloutBufferSamples:
        actions = self.to_torch(self.actions[steps].astype(np.float32, copy=False))
        arrays = (self.values, self.log_probs, self.advantages, self.returns)
        observations = self._gather_observations(steps)
        rest = (actions, *(self.to_torch(array[steps]) for array in arrays))
        if isinstance(observations, dict):
            return DictRolloutBufferSamples(observations, *rest)
        return RolloutBufferSamples(observations, *rest)


class DictEpisodeRolloutBuffer(EpisodeRolloutBuffer, DictRolloutBuffer):
    """:class:`EpisodeRolloutBuffer` for dict observations."""


def values_of(policy: ActorCriticPolicy, observations: Any) -> FloatArray:
    """Return V of a batch of an environment's observations, float64 [n]."""
    with torch.no_grad():
        values = state_values(policy, to_tensor(policy, observations))
    return values.cpu().double().numpy()


def bootstrap_values(
    policy: ActorCriticPolicy | None, next_observations: Observations, bootstrapped: BoolArray
) -> FloatArray:
    """Return V of the state after each segment, float64 [E]; 0 where it is not bootstrapped.

    ``policy`` may be ``None`` where nothing is.
    """
    values = np.zeros(len(bootstrapped))
    known = np.flatnonzero(bootstrapped)
    for start in range(0, len(known), CHUNK):
        rows = known[start : start + CHUNK]
        assert policy is not None  # by uses_critic
        with torch.no_grad():
            found = state_values(policy, take_rows(next_observations, rows))
        values[rows] = found.cpu().double().numpy()
    return values
