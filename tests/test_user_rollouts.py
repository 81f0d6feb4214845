"""The user's view of a rollout: buffer, locals, running moments, warnings, truncated episodes."""

from collections import deque

import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_crpn import CRPN
from sb3_crpn.algorithm import rollouts
from tests.envs import Drift, Rewards
from tests.training import make, several


class Buffers(BaseCallback):
    """Records the buffer's arrays at the end of a rollout."""

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        buffer = self.locals["rollout_buffer"]
        names = ("rewards", "values", "returns", "advantages", "observations", "log_probs")
        self.arrays = {name: getattr(buffer, name).copy() for name in names}
        self.actions, self.rows = buffer.actions.copy(), buffer.pos


class Constant(Drift):
    """A reward of 1 for each step, and random states."""

    def __init__(self, limit):
        super().__init__(bound=np.inf, limit=limit)

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, 1.0, *rest


@pytest.mark.parametrize("n_steps", [5, 40])
def test_callbacks_see_what_was_collected(n_steps):
    """Also of discarded steps: two environments continue until the third has its quota."""
    env = DummyVecEnv([lambda limit=limit: Constant(limit) for limit in (3, 5, 20)])
    model, seen = make(CRPN, env, n_steps=n_steps, n_critic_updates=0), Buffers()
    policy = model.policy
    model.learn(1, seen)
    assert {array.shape[:2] for array in seen.arrays.values()} == {(seen.rows, 3)}
    assert seen.arrays["rewards"].mean() == 1.0
    observations = torch.from_numpy(seen.arrays["observations"].reshape(-1, 2))
    with torch.no_grad():
        values = policy.predict_values(observations).numpy().reshape(-1, 3)
    np.testing.assert_allclose(seen.arrays["values"], values, rtol=1e-5)
    np.testing.assert_allclose(
        seen.arrays["returns"], seen.arrays["values"] + seen.arrays["advantages"], rtol=1e-4
    )
    assert (seen.arrays["log_probs"] < 0.0).all()
    assert (seen.arrays["advantages"] != 0.0).all()


@pytest.mark.parametrize("truncated", [True, False])
def test_values_after_the_end_are_those_of_the_last_state_or_zero(truncated):
    """Only time limits are bootstrapped: δ at its end is r + γV(s_H) - V(s_{H-1})."""

    class Ends(Constant):
        def step(self, action):
            observation, reward, _, ended, info = super().step(action)
            return observation, reward, ended and not truncated, ended and truncated, info

    last, seen = deque(maxlen=1), Buffers()

    class Keeps(Ends):
        def step(self, action):
            outcome = super().step(action)
            last.append(outcome[0])
            return outcome

    model = make(CRPN, Keeps(4), n_steps=4, n_critic_updates=0, gae_lambda=0.0, gamma=0.9)
    model.learn(1, seen)
    with torch.no_grad():
        value = model.policy.predict_values(torch.from_numpy(last[0])[None]).item()
    delta = 1.0 - seen.arrays["values"][3, 0] + (0.9 * value if truncated else 0.0)
    assert abs(value) > 1e-3
    assert seen.arrays["advantages"][3, 0] == pytest.approx(delta, rel=1e-5)


def test_environments_registered_without_a_time_limit_are_warned_of():
    env = Drift()
    env.spec = EnvSpec("Walk-v0", "tests.envs:Drift")
    with pytest.warns(UserWarning, match=r'Walk-v0 has no time limit.*horizon=H or rollout="time'):
        make(CRPN, env)
    make(CRPN, env, horizon=9)
    make(CRPN, env, rollout="timesteps")


def test_endless_episodes_end_with_the_budget():
    """A fifth of the rollout warns. Steps beyond a rollout or the budget are not simulated."""
    endless = several(2, bound=np.inf, limit=np.inf)
    with (
        pytest.warns(UserWarning, match="no episode has ended within 300 steps"),
        pytest.raises(ValueError, match=r"within 1500 steps.*horizon=H.*TimeLimit.*timesteps"),
    ):
        make(CRPN, endless).learn(3000)


def test_an_estimate_of_endless_episodes_ends(monkeypatch):
    monkeypatch.setattr(rollouts, "EPISODE_LIMIT", 100)
    model = make(CRPN, several(2, bound=np.inf, limit=np.inf), rollout="timesteps")
    with (
        pytest.warns(UserWarning, match="no episode has ended within 20 steps"),
        pytest.raises(ValueError, match=r"within 100 steps.*horizon=H.*training alone can do"),
    ):
        model.estimate_curvature(2)


@pytest.mark.parametrize("normalized", [False, True])
def test_cut_episodes_are_reported(normalized):
    """The logged return is in the rewards' own units."""
    env = DummyVecEnv([lambda: Rewards(Constant(np.inf), 3.0)] * 2)
    if normalized:
        env = VecNormalize(env)
    model = make(CRPN, env, horizon=10, n_episodes=4)
    model.learn(100)
    assert {(e["r"], e["l"]) for e in model.ep_info_buffer} == {(30.0, 10)}
    assert len(model.ep_info_buffer) == 4 * model._n_updates


class Locals(BaseCallback):
    """Compares ``self.locals`` with those of SB3's rollouts."""

    def _on_step(self):
        names = self.locals
        assert names["self"] is self.model
        assert names["env"] is self.training_env
        assert names["rollout_buffer"] is self.model.rollout_buffer
        assert names["n_rollout_steps"] == self.model.n_steps
        assert names["n_steps"] == self.n_calls
        if self.n_calls > 1:
            assert np.array_equal(names["obs_tensor"].numpy(), self.next)
        self.next = names["new_obs"]
        clipped = np.clip(names["actions"], -1.0, 1.0)
        assert np.array_equal(names["clipped_actions"], clipped)
        assert names["dones"].dtype == np.bool_
        assert len(names["infos"]) == len(names["rewards"]) == 2
        return self.n_calls < 8


@pytest.mark.parametrize("rollout", ["episodes", "timesteps"])
def test_locals_are_those_of_sb3(rollout):
    callback = Locals()
    make(CRPN, several(2, dim=1), rollout=rollout, n_steps=50).learn(1000, callback)
    assert callback.n_calls == 8
