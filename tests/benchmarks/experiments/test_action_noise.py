"""The metric with a weight of its own for the noise of the actions."""

import pytest
import torch
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.experiments.action_noise import WeightedNoise
from sb3_crpn import CRPN
from sb3_crpn.algorithm.update import UpdateData
from tests.envs import Drift


@pytest.mark.parametrize("weight", [1.0, 8.0])
def test_the_metric_weighs_the_noise_of_the_actions(weight):
    env = make_vec_env(lambda: Drift(dim=2), 2, seed=0)
    arguments = {"n_steps": 40, "policy_kwargs": {"net_arch": [4]}, "seed": 0, "device": "cpu"}
    models = [kind("MlpPolicy", env, **arguments) for kind in (CRPN, WeightedNoise)]
    models[1].weight = weight
    batch = models[0].estimate_curvature(4).gradient_batch
    plain, weighted = (model._estimate(UpdateData(batch, [])).fisher for model in models)
    tensors = models[0].actor.tensors
    noise = models[0].actor.flatten(
        torch.full_like(t, t is models[0].policy.log_std) for t in tensors
    )
    added = (weighted.to_dense() - plain.to_dense()).diagonal()
    # the Fisher information of log σ is 2 for each component, F is a mean over the two
    assert torch.allclose(plain.to_dense().diagonal()[noise > 0], torch.ones(2).double())
    assert torch.allclose(added, (weight - 1.0) * noise, atol=1e-8)
    basis, forms = weighted.krylov(torch.ones(len(noise)).double(), 3)
    assert torch.allclose(weighted.mean(forms), basis.T @ (weighted @ basis), atol=1e-8)
