"""Models with the settings of an entry in ``zoo_configs``, and the returns of their training."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from benchmarks.learning.run import learning_curve
from benchmarks.learning.settings import parse_setting, resolve
from sb3_crpn import CRPN


def make_model(env: str, seed: int, algorithm: type[CRPN] = CRPN, **arguments: Any) -> CRPN:
    """Return a model of ``env`` with its entry's settings, overridden by ``arguments``."""
    _, settings = resolve("CRPN", env, arguments)
    settings.pop("n_timesteps", None)
    keywords = settings.get("policy_kwargs")
    if isinstance(keywords, str):  # rl-zoo's format, "dict(...)"
        settings["policy_kwargs"] = parse_setting(keywords[len("dict(") : -1])
    envs: VecEnv = make_vec_env(env, settings.pop("n_envs", 1), seed=seed)
    if settings.pop("normalize", False):
        envs = VecNormalize(envs, gamma=settings.get("gamma", 0.99))
    return algorithm(settings.pop("policy"), envs, seed=seed, device="cpu", **settings)


class Returns(BaseCallback):
    """Records (end step, length, return) of all episodes, and ends training at the budget."""

    def __init__(self, timesteps: int) -> None:
        super().__init__()
        self._timesteps = timesteps
        self._episodes: list[tuple[int, int, float]] = []

    def _on_step(self) -> bool:
        if self.num_timesteps > self._timesteps:
            return False
        for info in self.locals["infos"]:
            if "episode" in info:  # raw rewards: VecNormalize is outside the monitor
                episode = info["episode"]
                self._episodes.append((self.num_timesteps, episode["l"], episode["r"]))
        return True

    def summary(self) -> dict[str, float]:
        """Return the mean return over training and over its last fifth."""
        n_envs = self.training_env.num_envs
        mean, curve = learning_curve(self._episodes, n_envs, self._timesteps)
        late = [value for steps, value in curve if steps > 0.8 * self._timesteps]
        return {"mean_return": mean, "late_return": float(np.nanmean(late))}
