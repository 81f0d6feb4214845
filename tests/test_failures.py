"""After any failure the policy is unchanged, can be saved and continues training."""

import os
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_crpn import ACRPN, PAPER
from sb3_crpn.algorithm.evaluation import CandidateEvaluator, StepEvaluation
from sb3_crpn.episodes import collector
from tests.envs import Drift, Faulty, FaultyReset, Rewards, Sampler
from tests.training import TrainLog, all_finite, both, make, same, several, tensors

NAN, INF = float("nan"), float("inf")


class CrashError(Exception):
    """An arbitrary failure."""


def with_reward(value, observation, reward, *rest):
    return observation, value, *rest


def with_observation(value, observation, *rest):
    return np.array([0.0, value], np.float32), *rest


def crash(error, *outcome):
    raise error


def die(*outcome):
    os._exit(1)


def goes_on(model, earlier, path):
    """Assert that the policy is unchanged, and that the model saves, loads and learns."""
    assert same(model, earlier)
    model.save(path)
    loaded = type(model).load(path, env=several(1), device="cpu")
    assert same(loaded, earlier)
    model.set_env(several(1))
    for survivor in (model, loaded):
        theta = survivor.actor.vector
        survivor.learn(50, reset_num_timesteps=False)
        assert all_finite(survivor)
        assert not torch.equal(survivor.actor.vector, theta)


@both
@pytest.mark.parametrize("value", [NAN, INF, -INF])
@pytest.mark.parametrize("what", ["reward", "observation"])
def test_not_finite(algorithm, what, value, tmp_path):
    fault = partial(with_reward if what == "reward" else with_observation, value)
    model = make(algorithm, DummyVecEnv([lambda: Faulty(Drift(), at=5, fault=fault)]))
    earlier = tensors(model)
    with pytest.raises(ValueError, match=f"non-finite {what} at timestep 5"):
        model.learn(100)
    assert model.num_timesteps == 5
    goes_on(model, earlier, tmp_path / "model")


@both
def test_not_finite_in_one_key_of_a_dict(algorithm):
    space = spaces.Dict({"x": spaces.Box(-1.0, 1.0, (2,)), "n": spaces.Discrete(2)})

    class Broken(Sampler):
        def step(self, action):
            observation, *rest = super().step(action)
            return observation | {"x": np.full(2, np.nan, np.float32)}, *rest

    model = make(algorithm, Broken(space, spaces.Discrete(2)), policy="MultiInputPolicy")
    with pytest.raises(ValueError, match="non-finite observation at timestep 1"):
        model.learn(100)


@both
def test_not_finite_at_the_reset(algorithm, tmp_path):
    model = make(algorithm, FaultyReset(Drift()))
    earlier = tensors(model)
    with pytest.raises(ValueError, match="non-finite observation at timestep 0"):
        model.learn(100)
    goes_on(model, earlier, tmp_path / "model")


@both
def test_not_finite_at_the_end_of_an_episode(algorithm, tmp_path):
    """The observation that a truncated episode's value is bootstrapped from."""

    class Broken(Drift):
        def step(self, action):
            observation, reward, _, truncated, info = super().step(action)
            return observation * (np.nan if truncated else 1.0), reward, False, truncated, info

    model = make(algorithm, Broken(limit=6))
    earlier = tensors(model)
    with pytest.raises(ValueError, match="non-finite terminal observation at timestep 6"):
        model.learn(100)
    goes_on(model, earlier, tmp_path / "model")


@both
@pytest.mark.parametrize("error", [KeyboardInterrupt, CrashError])
def test_exception_in_the_environment(algorithm, error, tmp_path):
    fault = partial(crash, error)
    model = make(algorithm, DummyVecEnv([lambda: Faulty(Drift(), at=65, fault=fault)]), n_steps=16)
    with pytest.raises(error):
        model.learn(1000)
    assert model._n_updates > 0
    goes_on(model, tensors(model), tmp_path / "model")


class Raise(BaseCallback):
    """Raises in the hook ``where``, the second time."""

    def __init__(self, where, error):
        super().__init__()
        self.calls, self.error = 0, error
        setattr(self, where, self.fail)

    def fail(self):
        self.calls += 1
        if self.calls == 2:
            raise self.error
        return True

    def _on_step(self):
        return True


@both
@pytest.mark.parametrize("error", [KeyboardInterrupt, CrashError])
@pytest.mark.parametrize("where", ["_on_step", "_on_rollout_start", "_on_rollout_end"])
def test_exception_in_a_callback(algorithm, where, error, tmp_path):
    model = make(algorithm)
    with pytest.raises(error):
        model.learn(1000, Raise(where, error))
    goes_on(model, tensors(model), tmp_path / "model")


@both
@pytest.mark.parametrize("trial", [1, 3])
def test_interrupt_while_steps_are_tried(algorithm, trial, monkeypatch, tmp_path):
    """A trial step changes the actor. An interrupt restores it."""
    model = make(algorithm, target_kl=0.02).learn(20)
    earlier, evaluate, calls = tensors(model), CandidateEvaluator.evaluate, []

    def failing(self, step):
        calls.append(step)
        evaluation = evaluate(self, step)
        if len(calls) == trial:
            raise KeyboardInterrupt
        # a too long step, so that another trial follows
        return replace(evaluation, kl=1.0)

    monkeypatch.setattr(CandidateEvaluator, "evaluate", failing)
    with pytest.raises(KeyboardInterrupt):
        model.learn(20, reset_num_timesteps=False)
    monkeypatch.undo()
    goes_on(model, earlier, tmp_path / "model")


@both
def test_the_rollout_of_a_step_that_is_not_finite_is_not_reused(algorithm, monkeypatch):
    """A cause that makes one step non-finite persists in the next updates."""
    model, log, evaluate = make(algorithm, n_episodes=3), TrainLog(), CandidateEvaluator.evaluate

    def first_fails(self, step):
        evaluation = evaluate(self, step)
        return evaluation if model._n_updates else StepEvaluation(INF, INF)

    monkeypatch.setattr(CandidateEvaluator, "evaluate", first_fails)
    model.learn(100, log)
    assert log["n_reused_rollouts"][:3] == [0, 0, 1]
    assert log["step_rejected"][:2] == [1, 0]


def test_killed_worker(tmp_path):
    faulty = partial(Faulty, Drift(), at=20, fault=die)
    env = SubprocVecEnv([faulty], start_method="spawn")
    model = make(ACRPN, env, n_episodes=1)
    with pytest.raises((EOFError, OSError)):
        model.learn(1000)
    env.processes[0].join()
    assert model._n_updates > 0
    goes_on(model, tensors(model), tmp_path / "model")
    env.remotes[0].close()


@both
def test_endless_episodes(algorithm, monkeypatch):
    monkeypatch.setattr(collector, "ENDLESS", 40)
    endless = Drift(bound=INF, limit=INF)
    model = make(algorithm, endless)
    earlier = tensors(model)
    with pytest.raises(ValueError, match="horizon=H"):
        model.learn(100)
    assert model.num_timesteps == 40
    assert same(model, earlier)

    log = TrainLog()
    make(algorithm, endless, horizon=10, n_episodes=3).learn(100, log)
    assert log["n_episodes"] == [3, 3, 3, 3]
    assert log["used_timesteps_fraction"] == [1.0] * 4


@both
def test_one_endless_environment_among_others(algorithm, monkeypatch):
    monkeypatch.setattr(collector, "ENDLESS", 40)
    env = DummyVecEnv([Drift, lambda: Drift(bound=INF, limit=INF)])
    with pytest.raises(ValueError, match="horizon"):
        make(algorithm, env).learn(200)


SETTINGS = pytest.mark.parametrize(
    "settings",
    [{}, {"metric": "euclidean"}, {"normalize_advantage": False}, PAPER],
    ids=["default", "euclidean", "raw", "paper"],
)
FROM_RETURNS = {"baseline": False, "bootstrap_truncated": False, "gae_lambda": 1.0}


@both
@SETTINGS
def test_zero_rewards(algorithm, settings):
    """With g = 0, which holds exactly for a critic without rounding, the step is 0."""
    log = TrainLog()
    model = make(algorithm, Rewards(Drift(), 0.0), **(settings | FROM_RETURNS))
    model.learn(60, log)
    assert log["gradient_norm"][0] == log["step_norm"][0] == 0.0
    assert torch.equal(log.before[0], log.after[0])
    assert max(log["gradient_norm"]) < 1e-6
    assert max(log["kl_divergence"]) <= (model.target_kl or 1e-6)
    assert all_finite(model)


@both
@SETTINGS
@pytest.mark.parametrize("factor", [1e30, 1e-30])
def test_rewards_of_any_size(algorithm, settings, factor):
    model = make(algorithm, Rewards(Drift(), factor), **settings)
    model.learn(60)
    assert model._n_updates > 0
    assert all_finite(model)
    assert np.isfinite(model.policy.predict_values(torch.zeros(1, 2)).item())


@both
@pytest.mark.parametrize("actions", [spaces.Discrete(2), spaces.Box(-1.0, 1.0, (1,))])
def test_episodes_of_a_single_step(algorithm, actions):
    log = TrainLog()
    env = Sampler(spaces.Discrete(2), actions, length=1)
    model = make(algorithm, env, n_episodes=20).learn(60, log)
    assert log["n_episodes"] == [20, 20, 20]
    assert model.num_timesteps == 60
    assert all_finite(model)


@both
def test_a_single_episode(algorithm):
    """Noise and shrinkage cannot be estimated. The step is of first order."""
    log = TrainLog()
    model = make(algorithm, n_episodes=1, n_reused_rollouts=0).learn(30, log)
    assert np.isnan(log["gradient_noise"]).all()
    assert set(log["hessian_shrinkage"]) == {0.0}
    assert all_finite(model)


@both
@SETTINGS
@pytest.mark.parametrize(
    ("log_std", "what"), [(-25.0, "(a product|a projected matrix)"), (-40.0, "the gradient")]
)
def test_derivatives_that_overflow(algorithm, settings, log_std, what):
    """An error of the linear algebra, which no tuner handles, is caught too."""
    model = make(
        algorithm, Drift(dim=1), net_arch=(8,), policy_kwargs={"log_std_init": log_std}, **settings
    )
    before = tensors(model)
    with pytest.raises(ValueError, match=f"{what} is not finite.* raise alpha, or set target_kl"):
        model.learn(60)
    assert same(model, before)
