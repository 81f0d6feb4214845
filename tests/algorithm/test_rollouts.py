import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback

from sb3_crpn import CRPN
from sb3_crpn.algorithm.rollouts import TrainingRollouts
from tests.training import make, monitored, several


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


class EstimatesInMidRollout(BaseCallback):
    """Notes the exploration matrix before and after an estimate."""

    def _on_step(self):
        if self.num_timesteps == 3:
            before = self.model.policy.action_dist.exploration_matrices.clone()
            self.model.estimate_curvature(2, env=several(1, dim=2))
            after = self.model.policy.action_dist.exploration_matrices
            self.same = torch.equal(before, after)
        return True


def test_an_estimate_leaves_the_noise_of_the_rollout_in_progress():
    model = make(CRPN, several(3, dim=2), use_sde=True, sde_sample_freq=-1)
    callback = EstimatesInMidRollout()
    model.learn(30, callback)
    assert callback.same


def test_an_interrupted_estimate_says_where_the_environments_stand():
    """Environments that may not be reset in mid-episode go on from there."""
    env = monitored(early_resets=False, bound=np.inf, limit=12)
    model = make(CRPN, env, rollout="timesteps").learn(24)
    observe = env.step_wait

    def step_wait():
        seen.append(observe())
        if len(seen) == 5:
            raise KeyboardInterrupt
        return seen[-1]

    seen, env.step_wait = [], step_wait
    with pytest.raises(KeyboardInterrupt):
        model.estimate_curvature(3)
    assert np.array_equal(model._last_obs, seen[3][0])
