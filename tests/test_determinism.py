"""Seeded training gives the recorded parameters, bit for bit, also after a refactoring.

``python -m tests.test_determinism`` records the snapshot anew, after a change that is meant to
change numbers. On the processor and the library versions that it was recorded with, parameters
are compared bit for bit; elsewhere up to what rounding leaves of them after three updates.
"""

import hashlib
import json
import platform
import tempfile
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_crpn import ACRPN, CRPN, PAPER
from sb3_crpn.distributed import rank
from tests.envs import Drift, Sampler
from tests.ranks import run_ranks
from tests.training import make

SNAPSHOT = Path(__file__).with_name("determinism.json")
N_UPDATES = 3


def _sampler():
    space = spaces.Dict({"a": spaces.Box(-1.0, 1.0, (3,)), "b": spaces.Discrete(4)})
    return Sampler(space, spaces.MultiDiscrete([3, 2]), length=6)


CASES = {
    "discrete": lambda algorithm: make(algorithm, make_vec_env("CartPole-v1", 2, seed=0)),
    "continuous": lambda algorithm: make(
        algorithm, make_vec_env(lambda: Drift(dim=2), 3, seed=0), n_reused_rollouts=0
    ),
    "reuse": lambda algorithm: make(
        algorithm, make_vec_env("Pendulum-v1", 2, seed=0), n_steps=200, n_reused_rollouts=2
    ),
    "dict": lambda algorithm: make(
        algorithm, DummyVecEnv([_sampler] * 2), policy="MultiInputPolicy"
    ),
    "timesteps": lambda algorithm: make(
        algorithm,
        make_vec_env("CartPole-v1", 3, seed=0),
        rollout="timesteps",
        discount_visitation=True,
    ),
    "endless": lambda algorithm: make(
        algorithm,
        make_vec_env(lambda: Drift(bound=np.inf, limit=np.inf, dim=2), 2, seed=0),
        rollout="timesteps",
        n_reused_rollouts=1,
    ),
    "paper": lambda algorithm: make(
        algorithm, gym.make("CartPole-v1"), n_episodes=5, n_hessian_episodes=3, alpha=1e3, **PAPER
    ),
}
IDS = [f"{algorithm.__name__}-{case}" for case in CASES for algorithm in (CRPN, ACRPN)]


def trained(identity):
    """The policy's parameters after some updates, float32 [n]."""
    name, case = identity.split("-")
    model = CASES[case]({"CRPN": CRPN, "ACRPN": ACRPN}[name])
    return _parameters(_train(model))


def _train(model):
    """Learn in one call, so that later updates reuse previous rollouts."""
    stop = While(lambda: model._n_updates < N_UPDATES)
    return model.learn(10**6, stop)


class While(BaseCallback):
    """Trains while ``condition`` holds."""

    def __init__(self, condition):
        super().__init__()
        self.condition = condition

    def _on_step(self):
        return self.condition()


def _parameters(model):
    vector = torch.nn.utils.parameters_to_vector(model.policy.parameters())
    return vector.detach().numpy().copy()


def on_ranks(folder, **arguments):
    """Parameters after updates on this rank, with separate environments."""
    env = make_vec_env(lambda: Drift(), 2, seed=rank())
    model = make(CRPN, env, n_steps=48, **arguments).learn(200)
    return _parameters(model)


def timesteps_on_ranks(folder):
    """The same from timesteps."""
    return on_ranks(folder, rollout="timesteps")


# run in tests/test_distributed.py, which has the processes
ON_RANKS = {"CRPN-ranks": on_ranks, "CRPN-ranks-timesteps": timesteps_on_ranks}


def recorded(parameters):
    """A snapshot of ``parameters``: a hash of the bits, and some values to compare."""
    return {
        "sha256": hashlib.sha256(parameters.tobytes()).hexdigest(),
        "every_nth": [float(x) for x in parameters[:: max(1, len(parameters) // 16)]],
        "norm": float(np.linalg.norm(parameters)),
    }


def machine():
    """The processor and library versions that the bits depend on."""
    cpu = [line for line in _cpuinfo() if line.startswith(("model name", "cpu family", "model\t"))]
    versions = [torch.__version__, np.__version__, gym.__version__, platform.python_version()]
    return [*versions, torch.backends.cpu.get_cpu_capability(), *dict.fromkeys(cpu)]


def _cpuinfo():
    path = Path("/proc/cpuinfo")
    return path.read_text().splitlines() if path.exists() else [platform.processor()]


def check(identity, parameters):
    snapshot = json.loads(SNAPSHOT.read_text())
    now, then = recorded(parameters), snapshot["cases"][identity]
    if snapshot["machine"] == machine():
        assert now["sha256"] == then["sha256"]
    np.testing.assert_allclose(now["every_nth"], then["every_nth"], rtol=1e-2, atol=1e-3)
    assert now["norm"] == pytest.approx(then["norm"], rel=1e-3)


@pytest.mark.parametrize("identity", IDS)
def test_parameters_are_as_recorded(identity):
    check(identity, trained(identity))


def _record():
    torch.set_num_threads(1)
    cases = {identity: recorded(trained(identity)) for identity in IDS}
    with tempfile.TemporaryDirectory() as folder:
        _, results = run_ranks(list(ON_RANKS.values()), folder)
    cases |= {name: recorded(own) for name, (own, _) in zip(ON_RANKS, results, strict=True)}
    SNAPSHOT.write_text(json.dumps({"machine": machine(), "cases": cases}, indent=1) + "\n")


if __name__ == "__main__":
    _record()
