"""Small models, and the state that tests compare."""

import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_crpn import ACRPN, CRPN
from tests.envs import Drift

both = pytest.mark.parametrize("algorithm", [CRPN, ACRPN])


def make(
    algorithm, env=None, *, policy="MlpPolicy", net_arch=(8,), policy_kwargs=None, **arguments
):
    """Return a small model, in Drift unless told otherwise."""
    if algorithm is ACRPN:
        arguments.setdefault("subsolver_steps", 30)
    settings = {"n_steps": 32, "seed": 0, "device": "cpu", "n_critic_updates": 2} | arguments
    kwargs = {"net_arch": list(net_arch), **(policy_kwargs or {})}
    return algorithm(policy, Drift() if env is None else env, policy_kwargs=kwargs, **settings)


def several(n_envs=3, **arguments):
    return DummyVecEnv([lambda: Drift(**arguments)] * n_envs)


def monitored(n_envs=1, *, early_resets=True, **arguments):
    return DummyVecEnv([lambda: Monitor(Drift(**arguments), None, early_resets)] * n_envs)


def tensors(model):
    """Return copies of the policy's tensors."""
    return {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}


def same(model, earlier):
    """Return whether the policy's tensors equal those that ``tensors`` returned, bit for bit."""
    now = model.policy.state_dict()
    return all(torch.equal(now[name], tensor) for name, tensor in earlier.items())


def all_finite(model):
    return all(bool(torch.isfinite(tensor).all()) for tensor in model.policy.parameters())


class TrainLog(BaseCallback):
    """Records the ``train/`` entries of each update, and the actor before and after it."""

    def __init__(self):
        super().__init__()
        self.rows, self.before, self.after = [], [], []

    def _on_step(self):
        return True

    def _on_rollout_start(self):
        self._keep()

    def _on_rollout_end(self):
        self.before.append(self.model.actor.vector)

    def _on_training_end(self):
        self._keep()

    def _keep(self):
        if len(self.before) > len(self.rows):
            logged = self.logger.name_to_value.items()
            self.rows.append({k.removeprefix("train/"): v for k, v in logged if "train/" in k})
            self.after.append(self.model.actor.vector)

    def __getitem__(self, key):
        return [row[key] for row in self.rows]
