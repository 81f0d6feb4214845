"""ACRPN as the paper's Algorithm 2: its three branches and its early termination."""

import math

import pytest
import torch
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_crpn import ACRPN, PAPER
from sb3_crpn.cubic import cubic_finalsolver, cubic_subsolver
from tests.envs import Drift, Rewards
from tests.oracle import paper_estimates
from tests.training import TrainLog, make, tensors

# ‖g‖ is about 10 and ‖H‖ about 100 here
BRANCHES = {
    "Cauchy": {"alpha": 100.0, "gradient_lipschitz": 1.0, "sosp_epsilon": 1e-4},
    "descent": {"alpha": 1.0, "gradient_lipschitz": 400.0, "sosp_epsilon": 1e-4},
    "final": {"alpha": 1.0, "gradient_lipschitz": 1e4, "sosp_epsilon": 10.0},
}


@pytest.mark.parametrize("branch", BRANCHES)
@pytest.mark.parametrize("dim", [0, 2], ids=["Discrete", "Box"])
def test_paper_settings_are_algorithm_2(branch, dim):
    settings = BRANCHES[branch]
    env = DummyVecEnv([lambda: Drift(limit=40.0, dim=dim)] * 2)
    model = make(ACRPN, env, net_arch=[], n_episodes=6, subsolver_steps=25, **settings, **PAPER)
    theta, log, seeds, solver_of = model.actor.vector, TrainLog(), [], model._update_solver

    def recorded(batch):
        solver = solver_of(batch)
        seeds.append(solver.seed)
        return solver

    model._update_solver = recorded
    model.learn(1, log)
    gradient, hessian, _ = paper_estimates(model, theta, model.rollout_buffer, quota=3)

    alpha, lipschitz, epsilon = settings.values()
    large = alpha * float(gradient.norm()) >= lipschitz**2
    assert large == (branch == "Cauchy")
    arguments = (gradient, lambda vector: hessian @ vector, alpha)
    options = {"gradient_lipschitz": lipschitz, "epsilon": epsilon, "max_steps": 25}
    expected = cubic_subsolver(*arguments, seed=seeds[0], **options)
    small = -expected.predicted_decrease >= -math.sqrt(epsilon**3 / alpha) / 100
    assert small == (branch == "final")
    if small:
        expected = cubic_finalsolver(*arguments, **options)
    assert float(expected.step.norm()) > 0
    step = model.actor.vector - theta
    assert float((step - expected.step).norm()) <= 1e-3 * float(expected.step.norm())
    assert log["predicted_decrease"] == pytest.approx([expected.predicted_decrease], rel=1e-3)
    assert log["hessian_vector_products"] == [expected.products]
    assert model.last_update.at_sosp == small
    assert model.last_update.certified == expected.certified
    assert model.last_update.solver_status == expected.status


@pytest.mark.parametrize(
    "settings",
    [PAPER, {}, {"metric": "euclidean"}, {"target_kl": None}],
    ids=["paper", "default", "euclidean", "fixed alpha"],
)
@pytest.mark.parametrize("gradient_lipschitz", ["auto", 1e4])
def test_every_setting_decreases_its_model(settings, gradient_lipschitz):
    log = TrainLog()
    make(
        ACRPN,
        gradient_lipschitz=gradient_lipschitz,
        sosp_epsilon=1e-6,
        **{"alpha": 50.0} | settings,
    ).learn(100, log)
    assert min(log["predicted_decrease"]) > 0
    assert min(log["step_norm"]) > 0


EASY = {"sosp_epsilon": 1e4, "gradient_lipschitz": 400.0}


@pytest.mark.parametrize("settings", [PAPER, {}], ids=["paper", "default"])
def test_stop_at_sosp_ends_training_until_the_next_learn(settings):
    model, log = make(ACRPN, stop_at_sosp=True, **EASY, **settings), TrainLog()
    model.learn(10_000, log)
    assert len(log.rows) == model._n_updates == 1
    assert model.num_timesteps < 100
    model.learn(10_000, reset_num_timesteps=False)
    assert model._n_updates == 2


def test_stop_at_sosp_is_saved_and_off_by_default(tmp_path):
    model = make(ACRPN, stop_at_sosp=True, **EASY).learn(10_000)
    model.save(tmp_path / "model")
    loaded = ACRPN.load(tmp_path / "model", env=Drift(), device="cpu")
    assert loaded.stop_at_sosp
    assert loaded.learn(10_000, reset_num_timesteps=False)._n_updates == 2
    assert make(ACRPN, **EASY).learn(100)._n_updates > 1


def test_stop_at_sosp_goes_on_while_the_model_can_be_decreased():
    model = make(ACRPN, stop_at_sosp=True, sosp_epsilon=1e-9)
    assert model.learn(100)._n_updates > 1


def test_zero_rewards_are_stationary():
    model = make(ACRPN, Rewards(Drift(), 0.0), stop_at_sosp=True, **PAPER)
    earlier = tensors(model)
    model.learn(10_000)
    assert model._n_updates == 1
    assert all(torch.equal(model.policy.state_dict()[name], earlier[name]) for name in earlier)
