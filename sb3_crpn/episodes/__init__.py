"""Segments of trajectories: collection without length bias, storage, advantages, replay."""

from sb3_crpn.episodes.batch import EpisodeBatch, concatenate, episode_scan
from sb3_crpn.episodes.buffer import DictEpisodeRolloutBuffer, EpisodeRolloutBuffer
from sb3_crpn.episodes.collector import Collector, Transition
from sb3_crpn.episodes.replay import Replay
from sb3_crpn.episodes.tracker import (
    TRACKERS,
    EpisodeTracker,
    ProgressTracker,
    RolloutSize,
    Segment,
    TimestepTracker,
    Tracker,
    episodes_per_env,
    steps_to_quota,
)

__all__ = [
    "TRACKERS",
    "Collector",
    "DictEpisodeRolloutBuffer",
    "EpisodeBatch",
    "EpisodeRolloutBuffer",
    "EpisodeTracker",
    "ProgressTracker",
    "Replay",
    "RolloutSize",
    "Segment",
    "TimestepTracker",
    "Tracker",
    "Transition",
    "concatenate",
    "episode_scan",
    "episodes_per_env",
    "steps_to_quota",
]
