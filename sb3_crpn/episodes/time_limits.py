"""What is known of the environments' time limits."""

from __future__ import annotations

import warnings
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

# Where no time limit is known, an episode as long as this counts as endless. Training has its
# budget instead.
EPISODE_LIMIT = 10_000


def has_time_limit(env: VecEnv) -> bool:
    """Whether the specs of all environments are known, and have a time limit."""
    specs = _specs(env)
    return bool(specs) and all(getattr(spec, "max_episode_steps", None) for spec in specs)


def warn_of_endless_episodes(env: VecEnv) -> None:
    """Warn where an environment is registered without a time limit and may thus never end."""
    for spec in _specs(env):
        if spec is not None and spec.max_episode_steps is None:
            warnings.warn(
                f"{spec.id} has no time limit, and whole episodes are learnt from: if its episodes "
                'do not end by themselves, pass horizon=H or rollout="timesteps"',
                stacklevel=4,
            )
            return


def _specs(env: VecEnv) -> list[Any]:
    """Return the environments' specs, none where a vectorised environment does not tell."""
    try:
        return env.get_attr("spec")
    except (AttributeError, NotImplementedError):
        return []
