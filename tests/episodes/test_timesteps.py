"""Rollouts of timesteps: their segments, times and bootstrap values.

tests/curvature/test_segments.py tests the expectations of their estimates.
"""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_crpn import ACRPN, CRPN
from sb3_crpn.episodes import RolloutSize, TimestepTracker
from sb3_crpn.episodes.batch import concatenate, episode_time
from sb3_crpn.sosp import certify_sosp
from tests.envs import Drift, Rewards, Sampler
from tests.test_determinism import While
from tests.training import TrainLog, all_finite, both, make, same, several, tensors


@st.composite
def histories(draw):
    """Ends of episodes, [n_rollouts, n_steps, n_envs], and resets before rollouts, [n_rollouts]."""
    shape = draw(st.tuples(st.integers(1, 3), st.integers(1, 6), st.integers(1, 3)))
    return draw(arrays(bool, shape)), draw(arrays(bool, shape[0]))


@given(histories())
@settings(deadline=None)
def test_every_step_is_in_one_segment_at_its_time_in_its_trajectory(history):
    """A trajectory is identified by its first step, counted over all rollouts."""
    dones, resets = history
    n_rollouts, n_steps, n_envs = dones.shape
    tracker, times, clock = TimestepTracker(), np.zeros(n_envs, int), 0
    began, numbers = np.zeros(n_envs, int), {}
    for rollout in range(n_rollouts):
        if resets[rollout]:
            times, began = np.zeros(n_envs, int), np.full(n_envs, clock)
        tracker.begin(RolloutSize(n_steps, 1), times)
        seen, expected = np.zeros((n_steps, n_envs), int), np.zeros((n_steps, n_envs, 2), int)
        for row in range(n_steps):
            assert not tracker.complete
            expected[row] = np.stack([times, began], axis=1)
            times, clock = np.where(dones[rollout, row], 0, times + 1), clock + 1
            began = np.where(dones[rollout, row], clock, began)
            for segment in tracker.advance(dones[rollout, row]):
                rows = np.arange(segment.start, segment.start + segment.length)
                seen[rows, segment.env] += 1
                first = expected[segment.start, segment.env]
                assert first[0] == segment.time
                assert (np.diff(expected[rows, segment.env], axis=0) == [1, 0]).all()
                assert segment.cut == (not dones[rollout, row, segment.env])
                assert rows[-1] == row
                number = numbers.setdefault((segment.env, first[1]), segment.trajectory)
                assert number == segment.trajectory
        assert tracker.complete
        assert (seen == 1).all()
    for env in range(n_envs):
        own = [number for (other, _), number in numbers.items() if other == env]
        assert len(set(own)) == len(own)


class Clock(gym.Env):
    """Observation and reward are the time in the episode, which ends after ``duration`` steps."""

    action_space = spaces.Discrete(2)
    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)

    def __init__(self, duration=np.inf, truncates=False):
        self.duration, self.truncates = duration, truncates

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.time += 1
        end = self.time >= self.duration
        terminated, truncated = end and not self.truncates, end and self.truncates
        return np.array([self.time], np.float32), float(self.time), terminated, truncated, {}


def clocks(*durations, algorithm=CRPN, early_resets=True, truncates=False, **arguments):
    """A model whose observations are the times that its tracker has to track."""
    made = [Monitor(Clock(each, truncates), None, early_resets) for each in durations]
    env = DummyVecEnv([lambda each=each: each for each in made])
    settings = {"rollout": "timesteps", "n_steps": 5, "net_arch": ()} | arguments
    return make(algorithm, env, **settings)


def knows_the_time(model):
    batch = model._batch(model.rollout_buffer)
    expected = episode_time(batch.lengths, batch.times)
    return np.array_equal(batch.observations.flatten().numpy(), expected)


def trained(model, n_rollouts=1):
    return model.learn(
        n_rollouts * model.n_steps * model.n_envs, reset_num_timesteps=model.num_timesteps == 0
    )


def test_exactly_n_steps_of_each_environment_are_learnt_from_and_none_is_reset():
    log = TrainLog()
    model = clocks(3, 7, np.inf).learn(45, log)
    assert model.num_timesteps == 45
    assert log["used_timesteps_fraction"] == [1.0] * 3
    assert log["n_episodes"] == [2 + 1 + 1, 3 + 2 + 1, 2 + 2 + 1]  # segments
    assert knows_the_time(model)
    assert [env.unwrapped.time for env in model.env.envs] == [0, 1, 15]
    assert model.rollout_buffer._of_segments("time").max() == 10


@pytest.mark.parametrize("early_resets", [True, False])
def test_the_time_is_known_after_a_rollout_that_was_interrupted(early_resets):
    model = clocks(4, np.inf, early_resets=early_resets)
    model.learn(100, While(lambda: model.num_timesteps < 26))
    assert model.num_timesteps == 26
    trained(model)
    assert knows_the_time(model)
    assert model.rollout_buffer._of_segments("time").max() == 13  # no environment was reset


def test_calls_of_learn_that_a_callback_ends_reach_the_end_of_episodes():
    """As with PPO: 20 calls of 4 timesteps see episodes of 29."""
    model = clocks(29, n_steps=20)
    for _ in range(20):
        stop = While(lambda end=model.num_timesteps + 4: model.num_timesteps < end)
        model.learn(100, stop, reset_num_timesteps=model.num_timesteps == 0)
    assert model.num_timesteps == 80
    assert [info["l"] for info in model.ep_info_buffer] == [29, 29]


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_error_in_an_environment_resets_it_and_one_in_a_callback_does_not(error, monkeypatch):
    def fails(*_):
        raise error

    model = trained(clocks(np.inf))
    with pytest.raises(error):
        model.learn(9, While(fails), reset_num_timesteps=False)
    trained(model)
    assert knows_the_time(model)
    assert model.rollout_buffer._of_segments("time").max() == 6
    with monkeypatch.context() as patch:
        patch.setattr(Clock, "step", fails)
        with pytest.raises(error):
            trained(model)
    trained(model)
    assert knows_the_time(model)
    assert model.rollout_buffer._of_segments("time").max() == 0


@pytest.mark.parametrize("rollout", ["episodes", "timesteps"])
def test_a_file_saved_in_mid_rollout_resets_environments_that_have_gone_on(rollout, tmp_path):
    model = trained(clocks(9, 9, rollout=rollout))
    start = model.num_timesteps

    def saves():
        if model.num_timesteps == start + 6:
            model.save(tmp_path / "model")
        return model.num_timesteps < start + 12

    model.learn(20, While(saves), reset_num_timesteps=False)
    loaded = CRPN.load(tmp_path / "model", env=model.env, force_reset=False)
    loaded.learn(1, reset_num_timesteps=False)  # one rollout
    assert knows_the_time(loaded)


def test_a_discounted_visitation_of_an_endless_task_is_warned_of():
    settings = {"discount_visitation": True, "gamma": 0.5, "n_steps": 10}
    trained(clocks(np.inf, **settings))
    with pytest.warns(UserWarning, match=r"less than 0.001.*discount_visitation=False"):
        trained(clocks(np.inf, **settings), 2)


def test_a_single_timestep_cannot_be_normalised():
    with pytest.raises(ValueError, match=r"^CRPN: n_steps=1 is not allowed.*normalize_advantage"):
        clocks(5, n_steps=1)
    trained(clocks(5, n_steps=1, normalize_advantage=False))


@pytest.mark.parametrize("kind", [int, dict, lambda: None])
def test_a_rollout_has_to_be_made_by_a_tracker(kind):
    with pytest.raises(ValueError, match=r"^CRPN: rollout=.* is not allowed.*a class of Tracker"):
        clocks(5, rollout=kind)


@pytest.mark.parametrize("early_resets", [True, False])
def test_the_time_is_known_after_an_evaluation_in_the_training_environment(early_resets):
    model = clocks(4, 6, early_resets=early_resets)
    for _ in range(3):
        trained(model)
        assert knows_the_time(model)
        assert model.estimate_curvature(3).gradient_batch.lengths.min() >= 4
    trained(model)
    assert knows_the_time(model)


def test_the_time_is_known_in_another_environment_and_after_loading(tmp_path):
    model = trained(clocks(4, np.inf), 2)
    other = DummyVecEnv([lambda: Clock(6)] * 2)
    model.save(tmp_path / "model")
    model.set_env(other)
    trained(model)
    assert knows_the_time(model)
    loaded = CRPN.load(tmp_path / "model", env=DummyVecEnv([lambda: Clock(6)] * 3), device="cpu")
    trained(loaded)
    assert knows_the_time(loaded)


@both
def test_a_saved_model_goes_on_as_if_it_had_not_stopped(algorithm, tmp_path):
    def model():
        return clocks(4, np.inf, algorithm=algorithm, discount_visitation=True)

    first = trained(model(), 3)
    trained(first, 2)
    second = trained(model(), 3)
    second.save(tmp_path / "model")
    loaded = algorithm.load(
        tmp_path / "model", env=second.get_env(), force_reset=False, device="cpu"
    )
    trained(loaded, 2)
    assert knows_the_time(loaded)
    assert loaded.rollout_buffer._of_segments("time").max() == 20
    assert same(loaded, tensors(first))


def test_the_horizon_cuts_estimates_alone():
    model = clocks(np.inf, horizon=3)
    trained(model, 3)
    assert not model.ep_info_buffer
    assert model.rollout_buffer.lengths.tolist() == [5]
    assert model.estimate_curvature(4).gradient_batch.lengths.tolist() == [3] * 4


@pytest.mark.parametrize("truncates", [True, False])
@pytest.mark.parametrize("bootstrap_truncated", [True, False])
def test_segments_are_bootstrapped_with_the_value_of_the_state_that_follows(
    truncates, bootstrap_truncated
):
    model = clocks(
        3,
        np.inf,
        truncates=truncates,
        bootstrap_truncated=bootstrap_truncated,
        n_critic_updates=0,
        gae_lambda=0.8,
    )
    trained(model, 2)  # the second rollout begins at times 2 and 5
    batch = model._batch(model.rollout_buffer)
    with torch.no_grad():
        values = model.policy.predict_values(torch.arange(11.0)[:, None]).flatten().numpy()
    end = values[3] if truncates and bootstrap_truncated else 0.0
    assert batch.lengths.tolist() == [1, 3, 1, 5]
    assert batch.times.tolist() == [2, 0, 0, 5]
    assert len({*batch.trajectories}) == 4
    assert batch.bootstrapped.tolist() == [end != 0.0] * 2 + [True] * 2
    followers = values[batch.next_observations.flatten().long()]
    np.testing.assert_allclose(
        np.where(batch.bootstrapped, followers, 0.0), [end, end, values[1], values[10]]
    )
    assert abs(values[1]) > 1e-3


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1.0, 1.0, (3,)),
        spaces.Discrete(4),
        spaces.MultiDiscrete([3, 2]),
        spaces.MultiBinary(3),
        spaces.Box(0, 255, (36, 36, 1), np.uint8),
        spaces.Dict(a=spaces.Discrete(3), b=spaces.Box(-1.0, 1.0, (2,))),
    ],
    ids=["box", "discrete", "multi-discrete", "multi-binary", "image", "dict"],
)
def test_the_state_that_follows_is_kept_as_the_policy_takes_it(space):
    image, is_dict = len(space.shape or ()) == 3, isinstance(space, spaces.Dict)
    policy = "MultiInputPolicy" if is_dict else "CnnPolicy" if image else "MlpPolicy"
    env = DummyVecEnv([lambda: Sampler(space, spaces.Discrete(2))] * 2)
    apart = {"share_features_extractor": False}  # V is as it was
    arguments = {"rollout": "timesteps", "n_steps": 6, "n_critic_updates": 0}
    model = make(CRPN, env, policy=policy, policy_kwargs=apart, **arguments)
    batch = trained(model)._batch(model.rollout_buffer)
    values = model.policy.predict_values(batch.next_observations).flatten().detach().numpy()
    np.testing.assert_allclose(
        np.where(batch.bootstrapped, values, 0.0), model.rollout_buffer._terminal_values, rtol=1e-5
    )
    assert batch.bootstrapped.tolist() == [False] * 2 + [True] * 2


def test_advantages_are_those_of_sb3_where_no_time_limit_ends_an_episode():
    env = DummyVecEnv([lambda: Drift(limit=np.inf)] * 3)
    model = trained(make(CRPN, env, rollout="timesteps", n_steps=40, n_critic_updates=0), 2)
    ours = model.rollout_buffer
    theirs = RolloutBuffer(
        40,
        model.observation_space,
        model.action_space,
        gamma=model.gamma,
        gae_lambda=model.gae_lambda,
        n_envs=3,
    )
    for name in ("rewards", "values", "episode_starts"):
        setattr(theirs, name, getattr(ours, name).copy())
    with torch.no_grad():
        last = model.policy.predict_values(torch.as_tensor(model._last_obs))
    theirs.compute_returns_and_advantage(last, model._last_episode_starts)
    assert len(ours.lengths) > 4
    np.testing.assert_allclose(ours.advantages, theirs.advantages, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(ours.returns, theirs.returns, rtol=1e-4, atol=1e-5)


def test_a_trajectory_belongs_to_one_fold_whatever_the_number_of_rollouts():
    model = clocks(7, np.inf, np.inf, 12, n_reused_rollouts=2, target_kl=1e-4)
    model.learn(2 * 20)
    earlier = list(model.replay._batches)
    assert len(earlier) == 2
    joined = concatenate(earlier)
    assert set(earlier[0].trajectories) & set(earlier[1].trajectories)
    first, second = (set(joined.trajectories[fold]) for fold in joined.folds(2))
    assert first
    assert second
    assert not first & second
    assert len(first | second) == 5  # one environment has begun anew


def test_one_endless_trajectory_has_no_independent_half():
    """The noise of the Hessian cannot be estimated. The step is of first order."""
    log = TrainLog()
    clocks(np.inf).learn(10, log)
    assert log["hessian_shrinkage"] == [0.0] * 2
    assert np.isnan(log["gradient_noise"]).all()
    clocks(np.inf, np.inf, n_steps=20).learn(80, log)
    assert np.isfinite(log["gradient_noise"][-1])


@pytest.mark.parametrize("name", ["n_episodes", "n_hessian_episodes"])
@both
def test_a_number_of_episodes_is_refused(algorithm, name):
    with pytest.raises(ValueError, match=rf"{algorithm.__name__}: {name}=3 is not allowed, must"):
        make(algorithm, rollout="timesteps", **{name: 3})


def endless(n_envs=2):
    return DummyVecEnv([lambda: Rewards(Drift(bound=np.inf, limit=np.inf), 10.0)] * n_envs)


@pytest.mark.parametrize("normalized", [False, True])
def test_a_task_that_never_ends_is_learnt_estimated_and_certified(normalized):
    env = VecNormalize(endless()) if normalized else endless()
    log = TrainLog()
    model = make(CRPN, env, rollout="timesteps", n_steps=64, horizon=20, gamma=0.9)
    model.learn(3 * 128, log)
    assert log["is_line_search_success"] == [1] * 3
    rewards = model.rollout_buffer.rewards
    if normalized:
        assert abs(log["mean_reward"][-1]) > 2 * abs(rewards.mean())
    else:
        assert log["mean_reward"][-1] == pytest.approx(rewards.mean(), rel=1e-5)
    assert model.estimate_curvature(4).gradient_batch.lengths.tolist() == [20] * 4
    report = certify_sosp(model, 4, 1.0, env=endless())
    assert report.n_steps == 80
    trained(model)
    assert all_finite(model)


@pytest.mark.parametrize(
    "action_space",
    [
        spaces.Discrete(3),
        spaces.Box(-2.0, 2.0, (2,)),
        spaces.MultiDiscrete([3, 2]),
        spaces.MultiBinary(2),
    ],
    ids=lambda space: type(space).__name__,
)
def test_all_spaces(action_space):
    space = spaces.Dict({"a": spaces.Box(-1.0, 1.0, (3,)), "b": spaces.Discrete(4)})
    env = DummyVecEnv([lambda: Sampler(space, action_space, length=6)] * 2)
    model = make(CRPN, env, policy="MultiInputPolicy", rollout="timesteps", n_steps=10)
    before = tensors(model)
    model.learn(40)
    assert not same(model, before)
    assert all_finite(model)


def test_chunks_of_segments_change_nothing_but_rounding():
    models = [
        make(
            CRPN, several(4), rollout="timesteps", n_reused_rollouts=0, max_batch_timesteps=limit
        ).learn(256)
        for limit in (None, 40)
    ]
    torch.testing.assert_close(*(model.actor.vector for model in models), rtol=1e-3, atol=1e-4)


def test_the_objective_is_a_mean_over_steps():
    """TRPO's: for normalised advantages the gain per step of the surrogate itself."""
    log = TrainLog()
    make(ACRPN, several(2), rollout="timesteps", n_reused_rollouts=0).learn(128, log)
    gained = [-change for change in log["surrogate_change"]]
    np.testing.assert_allclose(log["policy_objective"], gained, atol=1e-9)
    assert max(gained) > 1e-4
