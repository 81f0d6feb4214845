import pytest

from sb3_crpn.algorithm.rollouts import TrainingRollouts


@pytest.mark.parametrize(
    ("sizes", "length", "expected"),
    [
        ((None, None), None, 1),
        ((None, None), 5.0, 4),
        ((7, None), None, 7),
        ((7, 9), 5.0, 9),
        ((None, 3), 5.0, 4),
        ((None, 9), 5.0, 9),
    ],
)
def test_the_larger_of_both_numbers_is_simulated(sizes, length, expected):
    """From ``n_steps`` = 10 a multiple of the two environments, at the last mean length."""
    rollouts = TrainingRollouts(mean_episode_length=length, batch_sizes=sizes)
    n_envs = 1 if length is None else 2
    assert rollouts._n_episodes(10, n_envs) == expected


def test_older_files_hold_the_state_as_attributes_of_the_model():
    attributes = {"_mean_episode_length": 7.5, "_interrupted": True, "_n_updates": 3}
    rollouts = TrainingRollouts()
    rollouts.adopt(attributes)
    assert rollouts == TrainingRollouts(mean_episode_length=7.5, interrupted=True)
    assert attributes == {"_n_updates": 3}
