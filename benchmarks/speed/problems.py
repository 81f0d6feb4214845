"""Fixed problems: networks and random episodes with the shapes of well-known tasks."""

from __future__ import annotations

from typing import Any, ClassVar, TypeVar

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from stable_baselines3.common.vec_env import VecEnv

from sb3_crpn.algorithm import PolicyNewtonAlgorithm
from sb3_crpn.episodes import EpisodeBatch
from sb3_crpn.vec_env import GymnasiumVecEnv

Algorithm = TypeVar("Algorithm", bound=PolicyNewtonAlgorithm)

# Dimension of the observations, and the actions
SHAPES: dict[str, tuple[int, spaces.Space[Any]]] = {
    "CartPole-v1": (4, spaces.Discrete(2)),
    "HalfCheetah-v5": (17, spaces.Box(-1.0, 1.0, (6,), np.float32)),
    "Humanoid-v5": (348, spaces.Box(-0.4, 0.4, (17,), np.float32)),
}


class Noise(VectorEnv[Any, Any, Any]):
    """Random observations and rewards with a task's shapes, in endless episodes."""

    metadata: ClassVar[dict[str, Any]] = {"autoreset_mode": AutoresetMode.DISABLED}

    def __init__(self, shape: str, num_envs: int) -> None:
        self.num_envs = num_envs
        self.size, self.single_action_space = SHAPES[shape]
        self.single_observation_space = spaces.Box(-np.inf, np.inf, (self.size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._rng = np.random.default_rng(0)

    def _observe(self) -> np.ndarray[Any, Any]:
        return self._rng.normal(size=(self.num_envs, self.size)).astype(np.float32)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        """Observe."""
        return self._observe(), {}

    def step(self, actions: Any) -> Any:
        """Observe, with a random reward."""
        no = np.zeros(self.num_envs, dtype=bool)
        return self._observe(), self._rng.normal(size=self.num_envs), no, no, {}


def noise(shape: str, num_envs: int) -> VecEnv:
    """Return :class:`Noise` as SB3 takes it."""
    return GymnasiumVecEnv(Noise(shape, num_envs))


def noise_model(
    algorithm: type[Algorithm],
    shape: str,
    n_steps: int,
    *,
    episode: int = 1000,
    width: int = 64,
    **arguments: Any,
) -> Algorithm:
    """Return a model of two hidden layers whose rollouts are ``n_steps`` steps of noise.

    The episodes take ``episode`` steps, or half of ``n_steps`` where that is less: two of them are
    the least that shows how noisy an estimate is.
    """
    length = min(episode, n_steps // 2)
    settings = {"n_steps": length, "horizon": length, "seed": 0, "device": "cpu"} | arguments
    return algorithm(
        "MlpPolicy",
        noise(shape, n_steps // length),
        policy_kwargs={"net_arch": [width, width]},
        **settings,
    )


def collect(model: PolicyNewtonAlgorithm) -> EpisodeBatch:
    """Return the next rollout as the update sees it."""
    callback = model._setup_learn(1)[1]
    model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)
    return model._batch(model.rollout_buffer)


def width_for(n_parameters: int, shape: str = "HalfCheetah-v5") -> int:
    """Return the width of two hidden layers that makes an actor of about ``n_parameters``.

    With n observations and k actions, d = w² + (n + k + 2)w + k, and k standard deviations more
    for continuous actions.
    """
    n_observations, actions = SHAPES[shape]
    continuous = isinstance(actions, spaces.Box)
    n_outputs = actions.shape[0] if continuous else int(actions.n)  # type: ignore[attr-defined]
    linear = n_observations + n_outputs + 2
    constant = n_outputs * (2 if continuous else 1)
    root = np.sqrt(linear**2 + 4.0 * max(0, n_parameters - constant))
    return max(1, round((root - linear) / 2.0))
