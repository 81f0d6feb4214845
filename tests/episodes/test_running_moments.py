import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_crpn import CRPN
from tests.envs import Drift, Faulty, FaultyReset
from tests.training import all_finite, make, several


def rms(normalizer):
    """The statistics of ``VecNormalize``."""
    moments = [normalizer.obs_rms, normalizer.ret_rms]
    return [a for m in moments for a in (m.mean, m.var, m.count)] + [normalizer.returns]


class StopAfter(BaseCallback):
    def __init__(self, n_calls):
        super().__init__()
        self.last = n_calls

    def _on_step(self):
        return self.n_calls < self.last


def nan_reward(observation, reward, *rest):
    return observation, np.nan, *rest


def nan_observation(observation, *rest):
    return observation * np.nan, *rest


@pytest.mark.parametrize("fault", [nan_reward, nan_observation])
@pytest.mark.parametrize("at", [2, 5])
def test_running_moments_forget_what_is_not_finite(fault, at):
    sound = VecNormalize(several(2))
    make(CRPN, sound).learn(1000, StopAfter(at - 1))
    faulty = DummyVecEnv([Drift, lambda: Faulty(Drift(), at=at, fault=fault)])
    env = VecNormalize(faulty)
    model = make(CRPN, env)
    with pytest.raises(ValueError, match=f"non-finite .* at timestep {2 * at}"):
        model.learn(1000)
    assert all(np.array_equal(a, b) for a, b in zip(rms(env), rms(sound), strict=True))
    theta = model.actor.vector
    model.learn(100)
    assert all_finite(model)
    assert not torch.equal(model.actor.vector, theta)


def test_running_moments_forget_a_reset_that_is_not_finite():
    env = VecNormalize(DummyVecEnv([lambda: FaultyReset(Drift())]))
    before = rms(VecNormalize(several(1)))
    with pytest.raises(ValueError, match="non-finite observation at timestep 0"):
        make(CRPN, env).learn(100)
    assert all(np.array_equal(a, b) for a, b in zip(rms(env), before, strict=True))
