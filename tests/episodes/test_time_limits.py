import gymnasium as gym
import pytest
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_crpn.episodes.time_limits import has_time_limit, warn_of_endless_episodes
from tests.envs import Drift
from tests.training import several


def registered(limit):
    env = Drift()
    env.spec = EnvSpec("Walk-v0", entry_point=Drift, max_episode_steps=limit)
    return env


class Silent(DummyVecEnv):
    """An adapter that does not tell its environments' specs."""

    def get_attr(self, attr_name, indices=None):
        if attr_name == "spec":
            raise NotImplementedError
        return super().get_attr(attr_name, indices)


@pytest.mark.parametrize(
    ("env", "expected"),
    [
        (DummyVecEnv([lambda: gym.make("CartPole-v1")]), True),
        (DummyVecEnv([lambda: registered(None)]), False),
        (DummyVecEnv([lambda: registered(9), lambda: registered(None)]), False),
        (several(2), False),  # without a spec
        (Silent([lambda: gym.make("CartPole-v1")]), False),
    ],
    ids=["limited", "unlimited", "one of two", "without a spec", "silent"],
)
def test_a_time_limit_is_known_where_every_spec_has_one(env, expected):
    assert has_time_limit(env) is expected


@pytest.mark.filterwarnings("error")
def test_a_registered_environment_without_a_time_limit_warns():
    with pytest.warns(UserWarning, match=r'Walk-v0 has no time limit.*horizon=H or rollout="time'):
        warn_of_endless_episodes(DummyVecEnv([lambda: registered(None)]))
    for quiet in (several(2), DummyVecEnv([lambda: registered(9)])):
        warn_of_endless_episodes(quiet)
