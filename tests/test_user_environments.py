"""Environments and adapters of users. Learning equals that from a clean equivalent."""

import re

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecMonitor

from sb3_crpn import CRPN
from sb3_crpn.sosp import certify_sosp
from tests.envs import Drift
from tests.training import TrainLog, all_finite, both, make, same, several, tensors

TAXI = max(name for name in gym.registry if re.fullmatch(r"Taxi-v\d", name))


class Adapter(VecEnvWrapper):
    """Changes the outcomes of environments, as adapters of other libraries do."""

    def __init__(self, venv, change):
        super().__init__(venv)
        self.change = change

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        return self.change(*self.venv.step_wait())


def with_dones(dtype):
    return lambda obs, rewards, dones, infos: (obs, rewards, dones.astype(dtype), infos)


def with_infos(change):
    return lambda obs, rewards, dones, infos: (obs, rewards, dones, [change(i) for i in infos])


def of_different_lengths():
    return DummyVecEnv(
        [lambda limit=limit: Drift(bound=np.inf, limit=limit) for limit in (3, 5, 9)]
    )


@both
@pytest.mark.parametrize("rollout", ["episodes", "timesteps"])
@pytest.mark.parametrize("dtype", [np.int64, np.float32])
def test_dones_of_any_type(algorithm, rollout, dtype):
    def train(env):
        log = TrainLog()
        model = make(algorithm, VecMonitor(env), rollout=rollout, n_steps=16).learn(150, log)
        return model, log, model.rollout_buffer.lengths.tolist()

    expected, _, lengths = train(of_different_lengths())
    model, log, own = train(Adapter(of_different_lengths(), with_dones(dtype)))
    assert same(model, tensors(expected))
    assert own == lengths
    assert len(log.rows) > 1
    if rollout == "episodes":
        assert set(own) == {3, 5, 9}
    assert {e["l"] for e in model.ep_info_buffer} == {3, 5, 9}


@pytest.mark.parametrize("dtype", [np.int64, np.float32])
def test_dones_of_any_type_in_a_certificate(dtype):
    model = PPO("MlpPolicy", Drift(), policy_kwargs={"net_arch": [4]}, device="cpu", seed=0)
    expected, report = (
        certify_sosp(model, 8, 1.0, env=Adapter(of_different_lengths(), with_dones(kind)), seed=0)
        for kind in (np.bool_, dtype)
    )
    assert report.n_steps == expected.n_steps
    assert float(report.gradient.norm()) == float(expected.gradient.norm()) > 0.0


class Pythonic(gym.Env):
    """Counts to ``limit`` and returns observations of Python's types, or arrays of the space's."""

    SPACES = {  # noqa: RUF012
        "int": (spaces.Discrete(20), lambda t: t),
        "list": (spaces.Box(-1.0, 20.0, (2,)), lambda t: [t, 0.5]),
        "list of int": (spaces.MultiDiscrete([20, 2]), lambda t: [t, t % 2]),
        "float64": (spaces.Box(-1.0, 20.0, (1,)), lambda t: np.array([t], np.float64)),
        "dict": (
            spaces.Dict({"t": spaces.Discrete(20), "x": spaces.Box(-1.0, 20.0, (2,))}),
            lambda t: {"t": t, "x": [t, 0.5]},
        ),
    }

    def __init__(self, kind, *, arrays=False):
        self.observation_space, self._value = self.SPACES[kind]
        self.action_space = spaces.Discrete(2)
        self._arrays = arrays

    def _observe(self):
        value, space = self._value(self.t), self.observation_space
        if not self._arrays:
            return value
        if isinstance(space, spaces.Dict):
            return {k: np.asarray(value[k], space[k].dtype) for k in space.spaces}
        return np.asarray(value, space.dtype)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self._observe(), {}

    def step(self, action):
        self.t += 1
        return self._observe(), float(action), False, False, {}


@pytest.mark.parametrize("kind", Pythonic.SPACES)
def test_observations_of_pythons_types_at_a_time_limit(kind):
    """The bootstrapped terminal observation is that of the environment."""
    policy = "MultiInputPolicy" if kind == "dict" else "MlpPolicy"

    def train(arrays):
        env = DummyVecEnv([lambda: TimeLimit(Pythonic(kind, arrays=arrays), 6)] * 2)
        return make(CRPN, env, policy=policy, n_steps=12).learn(60)

    expected, model = train(arrays=True), train(arrays=False)
    assert model._n_updates > 1
    assert same(model, tensors(expected))


@pytest.mark.parametrize("env_id", [TAXI, "FrozenLake-v1"])
@both
def test_toy_text(algorithm, env_id):
    env = gym.make(env_id, max_episode_steps=7)
    log = TrainLog()
    model = make(algorithm, env, n_episodes=4).learn(60, log)
    assert log["n_episodes"] == [4] * len(log.rows)
    assert max(model.rollout_buffer.lengths) <= 7
    assert all_finite(model)


class Pool:
    """A pool of environments as in EnvPool: batched, without SB3's query methods."""

    def __init__(self, n_envs):
        self._env = several(n_envs)
        self.num_envs, self.spec = n_envs, None
        self.observation_space = self._env.observation_space
        self.action_space = self._env.action_space

    def reset(self):
        return self._env.reset()

    def send(self, actions):
        self._env.step_async(actions)

    def recv(self):
        return self._env.step_wait()


class PoolAdapter(VecEnvWrapper):
    """EnvPool's example for SB3, shortened: a wrapper of an object that is no ``VecEnv``."""

    def seed(self, seed=None):
        """A pool is seeded at its construction."""

    def reset(self):
        return self.venv.reset()

    def step_async(self, actions):
        self.venv.send(actions)

    def step_wait(self):
        return self.venv.recv()


@pytest.mark.filterwarnings("ignore:The `render_mode` attribute is not defined:UserWarning")
@both
@pytest.mark.parametrize("horizon", [None, 8])
def test_adapters_that_answer_no_queries(algorithm, horizon):
    expected = make(algorithm, several(3), horizon=horizon).learn(200)
    model = make(algorithm, PoolAdapter(Pool(3)), horizon=horizon).learn(200)
    assert same(model, tensors(expected))
    assert model._n_updates > 1


def _without_terminal_observation(info):
    return {key: value for key, value in info.items() if key != "terminal_observation"}


def _with_none(info):
    return info | {"terminal_observation": None}


@pytest.mark.parametrize("change", [_without_terminal_observation, _with_none])
def test_a_truncated_episode_without_terminal_observation_is_not_bootstrapped(change):
    def train(env, **settings):
        return make(CRPN, env, **settings).learn(60)

    model = train(Adapter(several(2), with_infos(change)))
    assert same(model, tensors(train(several(2), bootstrap_truncated=False)))
    assert not same(model, tensors(train(several(2))))
