import numpy as np
import pytest
import torch
from gymnasium import spaces

from sb3_crpn.episodes import DictEpisodeRolloutBuffer, EpisodeRolloutBuffer
from sb3_crpn.episodes.advantages import generalized_advantages
from sb3_crpn.episodes.tracker import Segment

N_ENVS = 2
GAMMA, GAE_LAMBDA = 0.9, 0.8
BOX = spaces.Box(-np.inf, np.inf, (2,), np.float32)
# env 0: rows 0-1 and 2-6. env 1: rows 1-4. All other rows are discarded
ENDS = [Segment(0, 0, 2, False), Segment(1, 1, 4, False), Segment(0, 2, 5, True)]
TERMINAL_VALUES = [0.0, 0.0, 1.5]
KEPT = [(0, 0), (1, 0), *[(t, 1) for t in range(1, 5)], *[(t, 0) for t in range(2, 7)]]
N_ROWS = 7


def filled(observation_space=BOX, action_space=BOX, capacity=2):
    """A buffer of N_ROWS random rows, its input, and the rows of the valid steps."""
    is_dict = isinstance(observation_space, spaces.Dict)
    buffer = (DictEpisodeRolloutBuffer if is_dict else EpisodeRolloutBuffer)(
        capacity,
        observation_space,
        action_space,
        device="cpu",
        gamma=GAMMA,
        gae_lambda=GAE_LAMBDA,
        n_envs=N_ENVS,
    )
    observation_space.seed(0)
    action_space.seed(0)
    rng = np.random.default_rng(0)
    added = []
    for row in range(N_ROWS):
        observations = [observation_space.sample() for _ in range(N_ENVS)]
        if is_dict:
            stacked = {k: np.stack([o[k] for o in observations]) for k in observations[0]}
        else:
            stacked = np.stack(observations)
        actions = np.stack([action_space.sample() for _ in range(N_ENVS)])
        rewards = rng.normal(size=N_ENVS)
        values, log_probs = torch.from_numpy(rng.normal(size=(2, N_ENVS))).float()
        buffer.add(stacked, actions, rewards, np.zeros(N_ENVS), values, log_probs)
        added.append((observations, actions, rewards, values.numpy()))
        for end in ENDS:
            if end.start + end.length == row + 1:
                buffer.close(end)
    buffer._terminal_values = np.array(TERMINAL_VALUES)
    buffer._compute_advantages(*buffer._valid_steps())
    return buffer, added


def kept(added, field):
    return np.array([added[row][field][env] for row, env in KEPT])


def expected_advantages(added):
    return generalized_advantages(
        kept(added, 2).astype(np.float32).astype(float),
        kept(added, 3).astype(float),
        np.array(TERMINAL_VALUES),
        np.array([2, 4, 5]),
        GAMMA,
        GAE_LAMBDA,
    )


@pytest.mark.parametrize("capacity", [1, 2, 7, 100])
def test_storage_grows_and_keeps_what_it_holds(capacity):
    buffer, added = filled(capacity=capacity)
    assert buffer.buffer_size >= N_ROWS
    assert buffer.pos == N_ROWS
    assert buffer.lengths.tolist() == [2, 4, 5]
    batch = buffer.episode_batch(
        baseline=True, normalize_advantage=False, discount_visitation=False
    )
    np.testing.assert_array_equal(batch.observations, kept(added, 0))
    np.testing.assert_array_equal(batch.actions, kept(added, 1))
    np.testing.assert_array_equal(batch.values, kept(added, 3))
    np.testing.assert_allclose(batch.cost_advantages, -expected_advantages(added), atol=1e-6)


def test_a_reset_buffer_is_empty_and_keeps_its_capacity():
    buffer, _ = filled()
    capacity = buffer.buffer_size
    buffer.reset()
    assert buffer.pos == 0
    assert buffer.lengths.tolist() == []
    assert buffer.buffer_size == capacity == len(buffer.rewards) == len(buffer.observations)


@pytest.mark.parametrize("discount_visitation", [False, True])
@pytest.mark.parametrize("normalize_advantage", [False, True])
@pytest.mark.parametrize("baseline", [False, True])
def test_weights_are_negative_advantages(baseline, normalize_advantage, discount_visitation):
    buffer, added = filled()
    batch = buffer.episode_batch(
        baseline=baseline,
        normalize_advantage=normalize_advantage,
        discount_visitation=discount_visitation,
    )
    advantages = expected_advantages(added)
    returns = advantages + kept(added, 3)
    expected = advantages if baseline else returns
    if normalize_advantage:
        expected = (expected - expected.mean()) / expected.std()
    if discount_visitation:
        expected = expected * GAMMA ** np.concatenate([np.arange(n) for n in (2, 4, 5)])
    np.testing.assert_allclose(batch.cost_advantages, -expected, atol=1e-6)
    np.testing.assert_allclose(batch.returns, returns, atol=1e-6)


def test_dict_observations_are_gathered_by_key():
    space = spaces.Dict({"x": BOX, "n": spaces.Discrete(5)})
    buffer, added = filled(space)
    batch = buffer.episode_batch(
        baseline=True, normalize_advantage=False, discount_visitation=False
    )
    for key in space:
        expected = [added[row][0][env][key] for row, env in KEPT]
        np.testing.assert_array_equal(batch.observations[key].squeeze(), np.array(expected))
    assert buffer.observations["x"].shape[0] == buffer.buffer_size >= N_ROWS


def test_discrete_actions_are_whole_numbers():
    buffer, added = filled(action_space=spaces.Discrete(3))
    batch = buffer.episode_batch(
        baseline=True, normalize_advantage=False, discount_visitation=False
    )
    assert batch.actions.dtype == torch.int64
    np.testing.assert_array_equal(batch.actions, kept(added, 1))


@pytest.mark.parametrize("is_dict", [False, True])
@pytest.mark.parametrize("batch_size", [None, 4])
def test_get_yields_every_kept_step_once(is_dict, batch_size):
    space = spaces.Dict({"x": BOX, "n": spaces.Discrete(5)}) if is_dict else BOX
    buffer, added = filled(space)
    samples = list(buffer.get(batch_size))
    assert [len(s.actions) for s in samples] == ([11] if batch_size is None else [4, 4, 3])
    values = torch.cat([s.old_values for s in samples]).numpy()
    np.testing.assert_array_equal(np.sort(values), np.sort(kept(added, 3)))
    order = [kept(added, 3).tolist().index(value) for value in values]
    advantages = torch.cat([s.advantages for s in samples])
    np.testing.assert_allclose(advantages, expected_advantages(added)[order], atol=1e-6)
    actions = torch.cat([s.actions for s in samples])
    np.testing.assert_array_equal(actions, kept(added, 1)[order])
    for sample in samples:
        assert isinstance(sample.observations, dict) == is_dict
        np.testing.assert_allclose(sample.returns, sample.advantages + sample.old_values, atol=1e-6)
