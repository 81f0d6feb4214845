"""Whole episodes: quotas without length bias, storage, returns-to-go."""

from sb3_crpn.episodes.batch import EpisodeBatch, Observations, concatenate, episode_scan
from sb3_crpn.episodes.buffer import DictEpisodeRolloutBuffer, EpisodeRolloutBuffer
from sb3_crpn.episodes.replay import Replay
from sb3_crpn.episodes.tracker import EpisodeTracker, episodes_per_env, steps_to_quota

__all__ = [
    "DictEpisodeRolloutBuffer",
    "EpisodeBatch",
    "EpisodeRolloutBuffer",
    "EpisodeTracker",
    "Observations",
    "Replay",
    "concatenate",
    "episode_scan",
    "episodes_per_env",
    "steps_to_quota",
]
