"""Whole episodes: quotas without length bias, storage, returns-to-go."""

from sb3_crpn.episodes.batch import EpisodeBatch, Observations, concatenate, episode_scan
from sb3_crpn.episodes.buffer import DictEpisodeRolloutBuffer, EpisodeRolloutBuffer
from sb3_crpn.episodes.earlier import EarlierRollouts
from sb3_crpn.episodes.quota import EpisodeTracker, episodes_per_env, steps_to_quota

__all__ = [
    "DictEpisodeRolloutBuffer",
    "EarlierRollouts",
    "EpisodeBatch",
    "EpisodeRolloutBuffer",
    "EpisodeTracker",
    "Observations",
    "concatenate",
    "episode_scan",
    "episodes_per_env",
    "steps_to_quota",
]
