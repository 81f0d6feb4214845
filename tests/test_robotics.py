import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_crpn import ACRPN
from tests.training import TrainLog, make

robotics = pytest.importorskip("gymnasium_robotics", reason="gymnasium-robotics is not installed")
gym.register_envs(robotics)


def test_acrpn_trains_a_robot(tmp_path):
    env = gym.make("FetchReachDense-v4")
    model = make(ACRPN, env, policy="MultiInputPolicy", n_steps=100, net_arch=[16])
    theta, log = model.actor.vector, TrainLog()
    model.learn(250, log)
    assert len(log.rows) == 2
    assert log["step_rejected"] == [0, 0]
    assert not torch.equal(model.actor.vector, theta)
    model.save(tmp_path / "model")

    loaded = ACRPN.load(tmp_path / "model", env=env, device="cpu")
    observation, _ = env.reset(seed=0)
    actions = [agent.predict(observation, deterministic=True)[0] for agent in (model, loaded)]
    np.testing.assert_array_equal(*actions)
    assert env.action_space.contains(actions[0])
    assert evaluate_policy(loaded, Monitor(env), 1)[0] < 0
    assert loaded.learn(50, reset_num_timesteps=False)._n_updates == 3
