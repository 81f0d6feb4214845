import gymnasium as gym
import pytest
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback

from sb3_crpn import CRPN
from sb3_crpn.sosp import certify_sosp
from tests.sosp.problems import saddle


class InRollout(BaseCallback):
    def _on_step(self):
        with pytest.raises(RuntimeError, match="middle of a rollout"):
            certify_sosp(self.model, 4, epsilon=1.0)
        return self.n_calls < 3


@pytest.mark.parametrize("algorithm", [PPO, CRPN])
def test_a_rollout_in_progress_is_not_broken(algorithm):
    saddle(algorithm).learn(20, InRollout())


def test_models_without_a_stochastic_actor_are_refused():
    with pytest.raises(ValueError, match="DQNPolicy"):
        certify_sosp(DQN("MlpPolicy", "CartPole-v1", buffer_size=10), 4, 1.0)


def test_environments_of_other_spaces_are_refused():
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        certify_sosp(saddle(), 4, 1.0, env=gym.make("CartPole-v1"))
