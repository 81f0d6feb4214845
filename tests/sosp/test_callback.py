import numpy as np
import pandas as pd
import pytest
import torch
from sb3_contrib import TRPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from benchmarks.exact import TabularEnv, assign_actor
from sb3_crpn import ACRPN, CRPN
from sb3_crpn.sosp import SospCallback
from tests.sosp.problems import blind, optimised

ALGORITHMS = [PPO, A2C, TRPO, CRPN, ACRPN]


def model_of(algorithm, env_id="CartPole-v1", **arguments):
    env = make_vec_env(env_id, 2, seed=0)
    small = {"n_steps": 64, "policy_kwargs": {"net_arch": [8]}}
    return algorithm("MlpPolicy", env, seed=0, device="cpu", **small, **arguments)


def certifying(env_id="CartPole-v1", **options):
    few = {"n_eigenvalues": 1, "n_probes": 1}
    return SospCallback(50, make_vec_env(env_id), 4, 1.0, seed=0, **few, **options)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize(
    ("env_id", "options"), [("CartPole-v1", {}), ("Pendulum-v1", {"use_sde": True})]
)
def test_training_goes_on_as_without_it(algorithm, env_id, options):
    """Training is bit-equal, on Pendulum with gSDE, whose noise lasts over many steps."""
    parameters = []
    for callback in (None, certifying(env_id)):
        model = model_of(algorithm, env_id, **options)
        parameters.append(list(model.learn(200, callback).policy.parameters()))
    assert callback.report is not None
    assert all(map(torch.equal, *parameters))


def test_the_verdict_is_logged(tmp_path):
    model = model_of(PPO, batch_size=32)
    model.set_logger(configure(str(tmp_path), ["csv", "tensorboard"]))
    callback = certifying(verbose=1)
    model.learn(256, callback)
    model.logger.close()
    rows = pd.read_csv(tmp_path / "progress.csv").dropna(subset="sosp/verdict")
    assert list(rows["time/total_timesteps"]) == [100, 200]
    last = rows.iloc[-1]
    assert last["sosp/verdict"] == callback.report.verdict
    assert last["sosp/gradient_norm"] == pytest.approx(
        callback.report.gradient_norm.estimate, rel=1e-3
    )
    assert last["sosp/lambda_min"] == pytest.approx(callback.report.lambda_min.estimate, rel=1e-3)


@pytest.mark.parametrize("stop", [False, True])
def test_training_can_stop_at_an_sosp(stop):
    mdp = blind()
    model = PPO(
        "MlpPolicy",
        TabularEnv(mdp),
        gamma=mdp.gamma,
        learning_rate=0.0,
        n_steps=64,
        policy_kwargs={"net_arch": []},
        seed=0,
        device="cpu",
    )
    assign_actor(model.policy, optimised(mdp))
    env = DummyVecEnv([lambda: TabularEnv(mdp)] * 100)
    env.seed(0)
    callback = SospCallback(30, env, 2000, 0.5, 1.0, stop_at_sosp=stop, seed=0)
    model.learn(64, callback)
    assert callback.report.verdict == "sosp"
    assert model.num_timesteps == (30 if stop else 64)


def test_normalisation_is_that_of_training():
    env = VecNormalize(make_vec_env("CartPole-v1", 2, seed=0))
    own = VecNormalize(make_vec_env("CartPole-v1"), training=False)
    model = A2C("MlpPolicy", env, seed=0, device="cpu")
    model.learn(100, SospCallback(40, own, 4, 1.0))
    assert own.obs_rms.count > 80
    assert not np.allclose(own.obs_rms.mean, 0.0)


def test_wrong_combinations_are_named_by_the_constructor():
    with pytest.raises(ValueError, match=r"^SospCallback: bounds=None"):
        SospCallback(1, TabularEnv(blind()), 4, 1.0, interval="bernstein")
    with pytest.raises(TypeError, match=r"^SospCallback has no argument n_eigenvectors"):
        SospCallback(1, TabularEnv(blind()), 4, 1.0, n_eigenvectors=3)
