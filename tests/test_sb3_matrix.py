"""SB3's vectorised environments and wrappers, with every kind of space and both rollouts.

``tests/test_sb3_contract.py`` has observation × action spaces and policies.
"""

from functools import partial

import numpy as np
import pytest
from gymnasium.wrappers import FlattenObservation, FrameStackObservation
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from sb3_crpn import ACRPN, CRPN
from tests.envs import Drift, Rewards, Sampler
from tests.test_sb3_contract import ACTIONS, OBSERVATIONS, policy_for, trains
from tests.training import all_finite, both, make, same, several, tensors

rollouts = pytest.mark.parametrize("rollout", ["episodes", "timesteps"])
WRAPPERS = {
    "none": lambda env: env,
    "VecNormalize": VecNormalize,
    "VecFrameStack": lambda env: VecFrameStack(env, 2),
    "VecCheckNan": lambda env: VecCheckNan(env, raise_exception=True),
    "VecMonitor": VecMonitor,
    "all": lambda env: VecMonitor(VecNormalize(VecFrameStack(VecCheckNan(env), 2))),
}
# The spaces of each wrapper: only numbers are stacked and normalised
NUMBERS = ("Box", "image, channels last", "image, channels first")
SPACES_OF = {
    "none": tuple(OBSERVATIONS),
    "VecNormalize": ("Box",),
    "VecFrameStack": NUMBERS,
    "VecCheckNan": NUMBERS,
    "VecMonitor": tuple(OBSERVATIONS),
    "all": ("Box",),
}


def cells():
    """Every wrapper with and without Monitor and with both rollouts, and each space in turn."""
    for number in range(4 * len(WRAPPERS)):
        wrapper = list(WRAPPERS)[number // 4]
        spaces_of = SPACES_OF[wrapper]
        observations = spaces_of[(number + number // 4) % len(spaces_of)]
        actions = list(ACTIONS)[(number + number // 4) % 4]
        rollout = ("episodes", "timesteps")[number // 2 % 2]
        yield wrapper, number % 2 == 0, rollout, observations, actions


@pytest.mark.filterwarnings("ignore:The environment is already wrapped with a `Monitor`")
@pytest.mark.parametrize(
    ("wrapper", "monitor", "rollout", "observations", "actions"), list(cells())
)
def test_wrappers(wrapper, monitor, rollout, observations, actions):
    def made():
        env = Sampler(OBSERVATIONS[observations], ACTIONS[actions])
        return Monitor(env) if monitor else env

    env = WRAPPERS[wrapper](DummyVecEnv([made] * 2))
    policy, kwargs = policy_for(OBSERVATIONS[observations])
    settings = {"n_steps": 8, "krylov_dim": 4, "policy_kwargs": kwargs, "rollout": rollout}
    model = trains(make((CRPN, ACRPN)[monitor], env, policy=policy, **settings), timesteps=32)
    reported = monitor or wrapper in ("VecMonitor", "all")
    assert {e["l"] for e in model.ep_info_buffer} == ({4} if reported else set())


@rollouts
@pytest.mark.parametrize("wrapper", [VecCheckNan, VecMonitor])
def test_wrappers_that_watch_change_nothing(wrapper, rollout):
    expected = make(CRPN, several(2), rollout=rollout).learn(100)
    assert same(make(CRPN, wrapper(several(2)), rollout=rollout).learn(100), tensors(expected))


@rollouts
def test_stacked_frames_are_those_of_the_environment(rollout):
    """Also after an episode's end, where the last stacked frames are bootstrapped."""

    def stacked():
        return FlattenObservation(FrameStackObservation(Drift(), 2, padding_type="zero"))

    expected = make(CRPN, DummyVecEnv([stacked] * 2), rollout=rollout).learn(100)
    model = make(CRPN, VecFrameStack(several(2), 2), rollout=rollout).learn(100)
    assert same(model, tensors(expected))


@pytest.mark.parametrize("start_method", ["spawn", "forkserver"])
def test_subprocesses_are_as_good(start_method):
    env = SubprocVecEnv([Drift], start_method=start_method)
    try:
        model = make(ACRPN, env).learn(60)
    finally:
        env.close()
    assert same(model, tensors(make(ACRPN, several(1)).learn(60)))


@both
def test_set_env_with_another_number_of_environments(algorithm):
    """SB3 rejects another number of environments, except in ``load``."""
    model = make(algorithm, several(2)).learn(30)
    with pytest.raises(AssertionError, match="number of environments"):
        model.set_env(several(3))
    model.set_env(several(2))
    trains(model)


@both
def test_custom_objects(algorithm, tmp_path):
    make(algorithm).learn(30).save(tmp_path / "model")
    load = partial(algorithm.load, tmp_path / "model", env=Drift(), device="cpu")
    objects = {"n_steps": 24, "target_kl": 0.005, "learning_rate": 0.0, "alpha": lambda _: 3.0}
    model = load(custom_objects=objects)
    assert (model.n_steps, model.target_kl, model.lr_schedule(1.0)) == (24, 0.005, 0.0)
    critic = model.policy.value_net.weight.clone()
    model.learn(40)
    assert 0.0 < model.last_update.kl_divergence <= 0.005
    np.testing.assert_allclose(model.policy.value_net.weight.detach(), critic.detach(), rtol=1e-4)
    with pytest.raises(ValueError, match=f"{algorithm.__name__}: target_kl.*-1"):
        load(custom_objects={"target_kl": -1.0})


@both
@rollouts
@pytest.mark.parametrize("factor", [1.0, 1e-25])
def test_numpy_that_raises(algorithm, rollout, factor):
    """Also where powers of the discount factor underflow to 0."""
    with np.errstate(all="raise"):
        env = VecNormalize(DummyVecEnv([lambda: Rewards(Drift(limit=40, bound=9), factor)] * 2))
        model = make(algorithm, env, rollout=rollout, gamma=1e-9, n_steps=80).learn(160)
        model.estimate_curvature(2)
    assert model._n_updates > 0
    assert all_finite(model)
