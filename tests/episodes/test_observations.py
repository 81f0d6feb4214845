import numpy as np
import pytest
import torch
from gymnasium import spaces

from sb3_crpn.episodes.observations import (
    all_finite,
    as_arrays,
    as_observation,
    map_observations,
    take_rows,
)


@pytest.mark.parametrize(
    ("space", "observation", "expected"),
    [
        (spaces.Discrete(5), 3, np.int64(3)),
        (spaces.Box(-9.0, 9.0, (2,)), [1, 2], np.array([1.0, 2.0], np.float32)),
        (spaces.Box(0, 255, (1, 2), np.uint8), [[7, 8]], np.array([[7, 8]], np.uint8)),
        (spaces.MultiBinary(2), (True, False), np.array([1, 0], np.int8)),
    ],
)
def test_single_observations_become_arrays_of_the_space(space, observation, expected):
    array = as_observation(space, observation)
    assert array.dtype == space.dtype
    np.testing.assert_array_equal(array, expected)
    nested = as_observation(spaces.Dict({"x": space}), {"x": observation, "more": 0})
    assert list(nested) == ["x"]
    np.testing.assert_array_equal(nested["x"], expected)


def test_a_wrong_shape_is_said():
    with pytest.raises(ValueError, match=r"returned an observation of \(5,\), not \(3,\)"):
        as_observation(spaces.Box(-1.0, 1.0, (3,)), np.zeros(5))


def test_finite_means_every_key():
    bad = np.array([0.0, np.nan])
    assert all_finite(np.arange(2))
    assert not all_finite(bad)
    assert all_finite({"a": np.arange(2), "b": np.zeros(2)})
    assert not all_finite({"a": np.arange(2), "b": bad})


def test_batches_of_lists_become_arrays():
    np.testing.assert_array_equal(as_arrays([[1, 2], [3, 4]]), [[1, 2], [3, 4]])
    np.testing.assert_array_equal(as_arrays({"a": [1, 2]})["a"], [1, 2])


def test_map_observations_reaches_every_key():
    doubled = map_observations({"a": torch.ones(2)}, lambda tensor: 2.0 * tensor)
    assert doubled["a"].tolist() == [2.0, 2.0]
    assert map_observations(torch.ones(1), torch.neg).tolist() == [-1.0]


def test_rows_are_taken_key_by_key():
    pair = torch.arange(6.0).reshape(3, 2)
    assert take_rows(pair, np.array([2, 0])).tolist() == [[4.0, 5.0], [0.0, 1.0]]
    assert take_rows({"a": pair}, slice(1))["a"].tolist() == [[0.0, 1.0]]
