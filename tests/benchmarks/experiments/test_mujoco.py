import numpy as np
import pandas as pd
import pytest
import torch
import yaml

from benchmarks.experiments import mujoco
from sb3_crpn import CRPN, PAPER, zoo
from tests.envs import Drift
from tests.training import make


def test_the_settings_are_those_of_the_zoo():
    entries = yaml.safe_load(zoo.config_file("crpn_paper").read_text())
    for env, net_arch in mujoco.NET_ARCH.items():
        entry = {k: v for k, v in entries[env].items() if k not in ("n_timesteps", "policy")}
        network = entry.pop("policy_kwargs")
        assert network == f"dict(net_arch={net_arch}, activation_fn=nn.Tanh)"
        assert entry == mujoco.THE_PAPERS


def test_the_leftmost_eigenvector_is_that_of_the_matrix():
    model = make(CRPN, Drift(), net_arch=[6], n_episodes=4, **PAPER)
    estimate = model.estimate_curvature(6)
    value, vector = mujoco.leftmost(estimate)
    exact = torch.linalg.eigvalsh(estimate.hessian.to_dense())[0]
    assert value == pytest.approx(float(exact), rel=0.02)
    assert float(vector.norm()) == pytest.approx(1.0)
    share = mujoco.confirmed_share(model)
    assert np.isfinite(share)


def test_an_update_is_recorded_with_what_it_learnt_from():
    (row,) = mujoco.measure("Reacher-v5", "REINFORCE", 0, timesteps=1)
    assert (row["update"], row["timesteps"]) == (1, 5000)  # 100 episodes of 50 steps
    assert -100 < row["mean_return"] < -20
    assert row["step_norm"] == pytest.approx(1e-3 * row["gradient_norm"], rel=1e-3)
    rows = pd.DataFrame([{"env": "Reacher-v5", "learner": "REINFORCE", "seed": 0} | row])
    assert "| Reacher-v5 | REINFORCE | 1 | 1 |" in mujoco.table(rows)


def test_a_share_that_is_missing_after_training_is_not_the_one_before():
    rows = [
        {"env": "Humanoid-v5", "learner": "CRPN, paper", "seed": seed, "update": update}
        | dict.fromkeys(("mean_return", *mujoco.LOGGED, "kl_divergence"), 1.0)
        | {"confirmed": confirmed}
        for seed, run in enumerate([(0.25, float("nan"), float("nan")), (0.5, float("nan"), -2.0)])
        for update, confirmed in enumerate(run, 1)
    ]
    assert mujoco.table(pd.DataFrame(rows)).endswith("| 0.25, 0.5 | -2 |")
