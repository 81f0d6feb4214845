import time
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper
from gymnasium.wrappers import FlattenObservation, TimeLimit
from gymnasium.wrappers import vector as wrappers
from sb3_contrib import TRPO
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_crpn.vec_env import GymnasiumVecEnv

MODES = list(AutoresetMode)
N_ENVS = 4


class Walk(gym.Env):
    """A random walk with unique first and last observations and infos."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 7}  # noqa: RUF012
    render_mode = "rgb_array"

    def __init__(self, kind="box", limit=7):
        self.kind = kind
        self.limit = limit
        self.episode = 0
        self.observation_space = {
            "box": spaces.Box(-np.inf, np.inf, (3,), np.float32),
            "double": spaces.Box(-np.inf, np.inf, (3,), np.float64),
            "discrete": spaces.Discrete(1000),
            "dict": spaces.Dict(
                {"x": spaces.Box(-np.inf, np.inf, (2,), np.float32), "n": spaces.Discrete(1000)}
            ),
        }[kind]
        self.action_space = {
            "box": spaces.Discrete(2),
            "double": spaces.Box(-1.0, 1.0, (2,), np.float32),
            "discrete": spaces.MultiDiscrete([2, 3]),
            "dict": spaces.MultiBinary(2),
        }[kind]

    def _observe(self):
        if self.kind == "discrete":
            return self.steps * 100 + self.episode
        if self.kind == "dict":
            return {"x": np.array([self.x, self.episode], np.float32), "n": self.steps}
        return np.array([self.x, self.steps, self.episode])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.normal() + (options or {}).get("shift", 0.0)
        self.steps = 0
        self.episode += 1
        return self._observe(), {"born": self.episode}

    def step(self, action):
        self.x += 0.1 * float(np.sum(action)) + self.np_random.normal()
        self.steps += 1
        info = {"x": self.x, "pair": np.array([self.x, self.steps]), "deep": {"steps": self.steps}}
        if self.steps % 2:
            info["odd"] = f"step {self.steps}"
        # ``truncated`` together with ``terminated`` is no time limit
        terminated, truncated = abs(self.x) > 2.0, self.steps >= self.limit
        return self._observe(), self.x, terminated, truncated or self.x > 2.5, info

    def render(self):
        return np.full((2, 3, 3), self.steps, np.uint8)

    def double(self, value):
        return 2 * value


def make_fns(kind="box"):
    return [partial(Walk, kind) for _ in range(N_ENVS)]


def make_cartpole(num_envs=N_ENVS, **kwargs):
    return gym.make_vec(
        "CartPole-v1", num_envs=num_envs, vectorization_mode="vector_entry_point", **kwargs
    )


def assert_same(ours, theirs):
    """Equality of nested observations and infos, times of day aside."""
    if isinstance(theirs, dict):
        assert ours.keys() == theirs.keys()
        for key in theirs.keys() - {"t"}:
            assert_same(ours[key], theirs[key])
    elif isinstance(ours, np.ndarray):  # DummyVecEnv leaves terminal observations uncast
        np.testing.assert_array_equal(ours, np.asarray(theirs, dtype=ours.dtype))
    else:
        np.testing.assert_array_equal(ours, theirs)


def assert_equals_dummy(adapted, dummy, steps=80):
    adapted.action_space.seed(0)
    assert adapted.seed(3) == dummy.seed(3)
    assert_same(adapted.reset(), dummy.reset())
    assert adapted.reset_infos == dummy.reset_infos
    episodes = limits = 0
    for step in range(steps):
        if step == steps // 2:  # in the midst of episodes
            assert_same(adapted.reset(), dummy.reset())
        actions = np.array([adapted.action_space.sample() for _ in range(N_ENVS)])
        obs, rewards, dones, infos = adapted.step(actions)
        expected = dummy.step(actions)
        assert_same(obs, expected[0])
        np.testing.assert_array_equal(rewards, expected[1])
        np.testing.assert_array_equal(dones, expected[2])
        for info, expected_info in zip(infos, expected[3], strict=True):
            assert_same(info, expected_info)
        assert adapted.reset_infos == dummy.reset_infos
        assert rewards.dtype == expected[1].dtype
        assert dones.dtype == expected[2].dtype
        for leaf, other in zip(leaves(obs), leaves(expected[0]), strict=True):
            assert leaf.dtype == other.dtype
        episodes += int(dones.sum())
        limits += sum(info["TimeLimit.truncated"] for info in infos)
    assert episodes > limits > 0


def leaves(obs):
    return list(obs.values()) if isinstance(obs, dict) else [obs]


def monitored(fns):
    return DummyVecEnv([lambda fn=fn: Monitor(fn()) for fn in fns])


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("kind", ["box", "double", "discrete", "dict"])
@pytest.mark.parametrize("copy", [True, False])
def test_sync_equals_dummy_vec_env(mode, kind, copy):
    vector = SyncVectorEnv(make_fns(kind), copy=copy, autoreset_mode=mode)
    assert_equals_dummy(GymnasiumVecEnv(vector), monitored(make_fns(kind)))


@pytest.mark.parametrize(
    ("mode", "shared_memory"),
    [
        (AutoresetMode.NEXT_STEP, True),
        (AutoresetMode.SAME_STEP, False),
        (AutoresetMode.DISABLED, False),
    ],
)
def test_async_equals_dummy_vec_env(mode, shared_memory):
    vector = AsyncVectorEnv(make_fns("dict"), shared_memory=shared_memory, autoreset_mode=mode)
    adapted = GymnasiumVecEnv(vector)
    try:
        assert_equals_dummy(adapted, monitored(make_fns("dict")), steps=40)
        assert adapted.get_attr("kind") == ["dict"] * N_ENVS
        assert not adapted.has_attr("no_such_thing")
        adapted.set_attr("limit", 11, indices=[1, 2])
        assert adapted.get_attr("limit") == [7, 11, 11, 7]
        assert adapted.env_method("double", 4) == [8] * N_ENVS
        with pytest.raises(NotImplementedError, match=r"'double' on environments \[0\]"):
            adapted.env_method("double", 4, indices=0)
        assert adapted.env_is_wrapped(TimeLimit) == [False] * N_ENVS
    finally:
        adapted.close()


def test_observations_survive_the_next_step():
    adapted = GymnasiumVecEnv(SyncVectorEnv(make_fns(), copy=False))
    adapted.seed(0)
    first = adapted.reset()
    kept = first.copy()
    adapted.step(np.zeros(N_ENVS, int))
    np.testing.assert_array_equal(first, kept)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
def test_vector_wrappers_transform_first_and_last_observations(mode):
    vector = SyncVectorEnv(make_fns("dict"), autoreset_mode=mode)
    adapted = GymnasiumVecEnv(wrappers.FlattenObservation(vector))
    singles = [lambda: FlattenObservation(Walk("dict"))] * N_ENVS
    assert_equals_dummy(adapted, monitored(singles))


def test_cartpole_vector_entry_point_takes_the_steps_of_single_cartpoles():
    vector = make_cartpole(max_episode_steps=30)
    adapted = GymnasiumVecEnv(vector)
    singles = [gym.make("CartPole-v1", max_episode_steps=30) for _ in range(N_ENVS)]
    adapted.seed(1)
    obs = adapted.reset()
    rng = np.random.default_rng(0)
    total, lengths, limits = np.zeros(N_ENVS), np.zeros(N_ENVS, int), 0

    def align(i):
        singles[i].reset()
        singles[i].unwrapped.state = vector.state[:, i].copy()

    for i in range(N_ENVS):
        align(i)
    for _ in range(300):
        # balance half of the poles, so that some episodes reach the time limit
        actions = np.where(np.arange(N_ENVS) % 2, obs[:, 2] + obs[:, 3] > 0, rng.integers(2))
        obs, rewards, dones, infos = adapted.step(actions)
        total, lengths = total + rewards, lengths + 1
        for i, info in enumerate(infos):
            last, reward, terminated, truncated, _ = singles[i].step(int(actions[i]))
            np.testing.assert_allclose(info.get("terminal_observation", obs[i]), last, rtol=1e-5)
            assert rewards[i] == reward == 1.0
            assert dones[i] == (terminated or truncated)
            assert info["TimeLimit.truncated"] == (truncated and not terminated)
            limits += info["TimeLimit.truncated"]
            if dones[i]:
                assert info["episode"]["r"] == total[i]
                assert info["episode"]["l"] == lengths[i]
                total[i] = lengths[i] = 0
                assert np.abs(obs[i]).max() <= 0.05
                align(i)
    assert limits > 0


def test_cartpole_draws_the_first_states_that_its_autoreset_would():
    vector, plain = make_cartpole(1), make_cartpole(1)
    adapted = GymnasiumVecEnv(vector)
    adapted.seed(5)
    np.testing.assert_array_equal(adapted.reset(), plain.reset(seed=5)[0])
    actions, episodes = np.ones(1, int), 0
    for _ in range(60):
        obs, _, dones, _ = adapted.step(actions)
        expected = plain.step(actions)[0]
        if dones[0]:
            expected = plain.step(actions)[0]  # the reset step, which the adapter does not show
            episodes += 1
        np.testing.assert_array_equal(obs, expected)
    assert episodes > 3


def test_seeds_are_used_once_and_repeat_a_run():
    def rollout(adapted, seed):
        adapted.seed(seed)
        actions = np.zeros(N_ENVS, int)
        return np.stack([adapted.reset()] + [adapted.step(actions)[0] for _ in range(40)])

    for vector in (make_cartpole(), SyncVectorEnv(make_fns())):
        adapted = GymnasiumVecEnv(vector)
        assert adapted.seed(7) == [7, 8, 9, 10]
        first, again, other = rollout(adapted, 7), rollout(adapted, 7), rollout(adapted, 8)
        np.testing.assert_array_equal(first[..., :2], again[..., :2])
        assert not np.array_equal(first, other)
        assert not np.array_equal(adapted.reset(), adapted.reset())


def test_options_are_used_once_and_shared():
    adapted = GymnasiumVecEnv(SyncVectorEnv(make_fns()))
    adapted.set_options({"shift": 100.0})
    assert (adapted.reset()[:, 0] > 50).all()
    assert (adapted.reset()[:, 0] < 50).all()
    adapted.set_options([{"shift": 100.0}] * N_ENVS)
    assert (adapted.reset()[:, 0] > 50).all()
    with pytest.raises(ValueError, match="one dict of options for all"):
        adapted.set_options([{"shift": float(i)} for i in range(N_ENVS)])


class BatchedSameStep(VectorEnv):
    """A third-party environment: batched final observations, infos without masks, float16."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012
    num_envs = 2
    single_observation_space = spaces.Box(0, 9, (1,), np.float32)
    single_action_space = spaces.Discrete(2)
    action_space = spaces.MultiDiscrete([2, 2])
    final = True

    def reset(self, *, seed=None, options=None):
        return np.zeros((2, 1), np.float16), {}

    def step(self, actions):
        ends = np.array([True, False])
        infos = {"speed": np.array([1.0, 2.0]), "hull": np.eye(2), "final_info": {}}
        if self.final:
            infos["final_obs"] = np.array([[5.0], [0.0]])
        return np.zeros((2, 1), np.float16), np.ones(2, np.float16), ~ends & ends, ends, infos


class FlagsOfType(VectorWrapper):
    """Returns ``terminated`` and ``truncated`` as numbers, or as lists."""

    def __init__(self, env, convert):
        super().__init__(env)
        self.convert = convert

    def step(self, actions):
        obs, rewards, *ends, infos = self.env.step(actions)
        return obs, rewards, *map(self.convert, ends), infos


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("convert", [np.int64, np.float32, list])
def test_flags_of_any_type_are_handed_on_as_bool(mode, convert):
    adapted, expected = (
        GymnasiumVecEnv(FlagsOfType(SyncVectorEnv(make_fns(), autoreset_mode=mode), kind))
        for kind in (convert, np.bool_)
    )
    for env in (adapted, expected):
        env.seed(3)
        env.reset()
    n_ended = 0
    for _ in range(30):
        actions = np.zeros(N_ENVS, int)
        outcome, reference = adapted.step(actions), expected.step(actions)
        assert outcome[2].dtype == np.bool_
        for own, other in zip(outcome[:3], reference[:3], strict=True):
            np.testing.assert_array_equal(own, other)
        for own, other in zip(outcome[3], reference[3], strict=True):
            assert own["TimeLimit.truncated"] is other["TimeLimit.truncated"]
            assert own.keys() == other.keys()
        n_ended += outcome[2].sum()
    assert n_ended > N_ENVS


def test_third_party_same_step_environment():
    env = BatchedSameStep()
    adapted = GymnasiumVecEnv(env)
    adapted.reset()
    obs, _, dones, infos = adapted.step(np.zeros(2, int))
    assert obs.dtype == np.float32
    assert dones.tolist() == [True, False]
    assert infos[0]["terminal_observation"] == 5.0
    assert infos[0]["TimeLimit.truncated"]
    assert infos[1]["speed"] == 2.0
    assert infos[1]["hull"].tolist() == [0.0, 1.0]
    env.final = False
    with pytest.raises(ValueError, match="final_obs"):
        adapted.step(np.zeros(2, int))


def test_attributes_methods_and_images_of_sub_environments():
    fns = [lambda: TimeLimit(Walk(), 50)] * N_ENVS
    adapted = GymnasiumVecEnv(SyncVectorEnv(fns))
    adapted.reset()
    assert adapted.metadata["render_fps"] == 7
    assert adapted.render_mode == "rgb_array"
    assert [image.shape for image in adapted.get_images()] == [(2, 3, 3)] * N_ENVS
    assert adapted.render("rgb_array").shape == (4, 6, 3)
    assert adapted.env_is_wrapped(Monitor) == [True] * N_ENVS
    assert adapted.env_is_wrapped(TimeLimit, indices=[0, 2]) == [True, True]
    assert adapted.env_is_wrapped(gym.wrappers.ClipAction) == [False] * N_ENVS
    assert adapted.env_method("double", 3, indices=1) == [6]
    assert callable(adapted.get_attr("double", indices=0)[0])
    adapted.set_attr("limit", 9, indices=[3])
    adapted.set_attr("kind", "box")
    assert adapted.get_attr("limit") == [7, 7, 7, 9]
    assert not adapted.has_attr("no_such_thing")
    adapted.close()


def test_attributes_of_a_vector_entry_point_are_those_of_the_whole():
    vector = wrappers.ClipReward(make_cartpole(), max_reward=0.5)
    adapted = GymnasiumVecEnv(vector)
    adapted.reset()
    assert adapted.step(np.zeros(N_ENVS, int))[1].tolist() == [0.5] * N_ENVS
    assert adapted.get_attr("gravity", indices=[0, 1]) == [9.8, 9.8]
    adapted.set_attr("gravity", 1.0)
    assert vector.unwrapped.gravity == 1.0
    assert adapted.get_images() == [None] * N_ENVS
    assert adapted.env_is_wrapped(TimeLimit, indices=0) == [False]
    assert not adapted.has_attr("no_such_thing")
    with pytest.raises(NotImplementedError, match="shares 'gravity'"):
        adapted.set_attr("gravity", 1.0, indices=0)
    with pytest.raises(NotImplementedError, match="cannot call 'double'"):
        adapted.env_method("double", 1)


class UnknownNextStep(BatchedSameStep):
    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012


class NoMode(BatchedSameStep):
    metadata = {}  # noqa: RUF012


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (Walk, "must be a gymnasium.vector.VectorEnv"),
        (NoMode, "with None"),
        (UnknownNextStep, "SAME_STEP.*reset_mask=True"),
        (lambda: wrappers.NormalizeObservation(make_cartpole()), "VecNormalize"),
        (lambda: wrappers.NormalizeReward(SyncVectorEnv(make_fns())), "VecNormalize"),
        (lambda: wrappers.RecordEpisodeStatistics(make_cartpole()), "remove it"),
        (lambda: wrappers.DictInfoToList(make_cartpole()), "remove it"),
    ],
)
def test_what_cannot_be_adapted_exactly_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        GymnasiumVecEnv(make())


def test_async_next_step_needs_shared_memory():
    vector = AsyncVectorEnv(make_fns(), shared_memory=False)
    try:
        with pytest.raises(ValueError, match="shared_memory=True"):
            GymnasiumVecEnv(vector)
    finally:
        vector.close()


def test_reset_mask_is_taken_at_its_word():
    assert GymnasiumVecEnv(UnknownNextStep(), reset_mask=True).num_envs == 2


@pytest.mark.parametrize("algorithm", [PPO, TRPO])
def test_algorithms_train_on_cartpole(algorithm):
    adapted = GymnasiumVecEnv(make_cartpole(8))
    model = algorithm("MlpPolicy", adapted, n_steps=64, seed=0, device="cpu").learn(1500)
    statistics = [episode["r"] for episode in model.ep_info_buffer]
    assert 9 < np.mean(statistics) < 100


def test_ppo_trains_on_dict_observations():
    adapted = GymnasiumVecEnv(SyncVectorEnv(make_fns("dict")))
    model = PPO("MultiInputPolicy", adapted, n_steps=32, batch_size=64, seed=0, device="cpu")
    model.learn(256)
    assert model.ep_info_buffer


def test_evaluate_policy_reports_episode_statistics():
    adapted = GymnasiumVecEnv(make_cartpole(max_episode_steps=20))
    model = PPO("MlpPolicy", adapted, seed=0, device="cpu")
    returns, lengths = evaluate_policy(model, adapted, 10, return_episode_rewards=True)
    assert returns == lengths
    assert len(returns) == 10
    assert max(lengths) <= 20


def test_throughput_on_cartpole():
    """The target is 5. The threshold of 3 allows for a busy machine."""
    num_envs = 64
    actions = np.random.default_rng(0).integers(2, size=(40, num_envs))
    adapted = GymnasiumVecEnv(make_cartpole(num_envs))
    dummy = make_vec_env("CartPole-v1", num_envs)

    def seconds(env):
        start = time.perf_counter()
        for action in actions:
            env.step(action)
        return time.perf_counter() - start

    for env in (adapted, dummy):
        env.seed(0)
        env.reset()
        seconds(env)
    ratios = [seconds(dummy) / seconds(adapted) for _ in range(9)]
    assert np.median(ratios) >= 3, ratios
