import sys
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import TRPO
from scipy.stats import binom
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from benchmarks.exact import TabularEnv, coordination_mdp, random_mdp
from sb3_crpn import ACRPN, CRPN, PAPER
from sb3_crpn.sosp import SospReport, certify_sosp
from sb3_crpn.theory import Constants, softmax_linear
from tests.envs import Sampler
from tests.sosp.problems import SADDLE, blind, optimised, saddle, tabular

LAMBDA_MIN = -1.5  # at the saddle of the coordination MDP
# λ_max of the Fisher matrix of its two steps, features (1, 0, 1) and (0, 1, 1), π = ½: ½ · 3
FISHER = 1.5


@pytest.mark.parametrize("algorithm", [PPO, A2C, TRPO, CRPN, ACRPN])
def test_a_strict_saddle_is_told_from_its_episodes(algorithm):
    report = certify_sosp(saddle(algorithm, n_envs=20), 400, epsilon=0.5, rho=1.0, seed=0)
    assert isinstance(report, SospReport)
    assert report.verdict == "saddle"
    assert report.gradient_norm.lower == pytest.approx(0.0, abs=0.2)
    assert report.lambda_min.lower <= LAMBDA_MIN <= report.lambda_min.upper
    assert report.curvature_threshold == pytest.approx(-(0.5**0.5))
    assert report.n_episodes == 400
    assert report.n_steps == 800


def test_the_escape_direction_lowers_the_cost():
    mdp = coordination_mdp()
    direction = certify_sosp(saddle(n_envs=20), 200, epsilon=0.5, rho=1.0, seed=0).escape_direction
    assert direction.norm() == pytest.approx(1.0)
    assert direction @ mdp.hessian(SADDLE) @ direction < 0.9 * LAMBDA_MIN
    assert mdp.cost(SADDLE + 0.5 * direction) < mdp.cost(SADDLE) - 0.1


def test_the_direction_of_a_slope_does_not_ascend():
    theta = SADDLE + 0.3 * torch.randn(
        6, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )
    report = certify_sosp(tabular(coordination_mdp(), theta), 100, epsilon=0.1, seed=0)
    assert report.gradient @ report.escape_direction <= 0.0


def test_a_steep_policy_is_not_stationary():
    mdp = random_mdp(1)
    theta = torch.randn(
        mdp.n_parameters, dtype=torch.float64, generator=torch.Generator().manual_seed(5)
    )
    norm = mdp.gradient(theta).norm().item()
    report = certify_sosp(tabular(mdp, theta, n_envs=50), 1000, epsilon=0.3 * norm, rho=1.0, seed=0)
    assert report.verdict == "not stationary"
    assert report.gradient_norm.lower <= norm <= report.gradient_norm.upper


def test_an_optimised_policy_is_an_sosp():
    mdp = blind()
    theta = optimised(mdp)
    report = certify_sosp(tabular(mdp, theta, n_envs=100), 2000, epsilon=0.5, rho=1.0, seed=0)
    assert mdp.is_sosp(theta, 0.5, 1.0)
    assert report.verdict == "sosp"


def test_few_episodes_leave_it_undecided():
    assert certify_sosp(saddle(), 4, epsilon=0.05, rho=1.0, seed=0).verdict == "undecided"


@pytest.mark.parametrize("theta", [SADDLE, SADDLE + 0.5])
def test_estimates_are_unbiased_for_a_biased_training_configuration(theta):
    """Mean over certificates against the exact derivatives."""
    mdp = random_mdp(2)
    theta = theta.new_tensor(np.resize(theta.numpy(), mdp.n_parameters))
    model = tabular(mdp, theta, CRPN, n_envs=5, gae_lambda=0.5, hessian_lambda=0.0)
    gradients = torch.stack(
        [certify_sosp(model, 20, epsilon=1.0, seed=seed).gradient for seed in range(20)]
    )
    error = gradients.std(0) / 20**0.5
    assert torch.all((gradients.mean(0) - mdp.gradient(theta)).abs() < 4.5 * error + 1e-6)


def test_the_bernstein_intervals_hold_with_the_bounds_of_the_theory():
    mdp = coordination_mdp()
    constants = Constants(K=1.0, scores=softmax_linear(2.0**0.5), H=2, d=6)
    report = certify_sosp(
        saddle(), 50, 0.5, 1.0, interval="bernstein", bounds=(constants.M_1, constants.M_2), seed=0
    )
    assert report.gradient_norm.lower == 0.0
    assert report.gradient_norm.upper >= mdp.gradient(SADDLE).norm()
    assert report.lambda_min.lower <= LAMBDA_MIN <= report.lambda_min.upper
    assert report.verdict == "undecided"  # 50 episodes are few for a bound without assumptions


def test_rho_is_the_papers_alpha_or_matches_epsilon():
    paper = saddle(CRPN, alpha=7.0, n_episodes=4, **PAPER)
    assert certify_sosp(paper, 4, 0.1).rho == 7.0
    assert certify_sosp(paper, 4, 0.1, rho=2.0).rho == 2.0
    for model in (saddle(CRPN), saddle()):
        assert certify_sosp(model, 4, 0.1).rho == pytest.approx(4 * 0.1 * FISHER)


class Scaled(gym.RewardWrapper):
    def reward(self, reward):
        return 100.0 * reward


def test_default_thresholds_have_the_units_of_the_task():
    reports = []
    for wrap in (lambda env: env, Scaled):
        env = DummyVecEnv([lambda wrap=wrap: wrap(TabularEnv(coordination_mdp()))])
        env.seed(0)
        reports.append(certify_sosp(saddle(), 40, env=env, seed=0))
    plain, scaled = reports
    assert plain.epsilon == pytest.approx(0.1 * FISHER**0.5)  # every return is 1 or -1
    assert plain.curvature_threshold == pytest.approx(-0.2 * FISHER)
    assert "ε = 0.1 G/s, ρ = 4ε/s²" in str(plain)
    for name in ("epsilon", "rho", "curvature_threshold"):
        assert getattr(scaled, name) == pytest.approx(100.0 * getattr(plain, name))


def test_the_intervals_depend_on_no_threshold():
    def intervals(*thresholds):
        model = saddle()
        model.get_env().seed(0)
        report = certify_sosp(model, 20, *thresholds, seed=3)
        return report.gradient_norm, report.lambda_min

    assert intervals() == intervals(0.5) == intervals(0.01, 30.0)


def thresholds_of_an_adversary(report):
    """Thresholds at the limits of the intervals, from the same data, for every verdict."""
    of_gradient, of_curvature = report.gradient_norm, report.lambda_min
    for epsilon in (0.999 * of_gradient.lower, of_gradient.upper, 2.0 * of_gradient.upper):
        for curvature in (of_curvature.lower, 0.999 * of_curvature.upper, -1e-3):
            if epsilon > 0.0 and curvature < 0.0:
                yield epsilon, curvature**2 / epsilon


def test_thresholds_chosen_from_the_same_episodes_keep_the_confidence():
    """Default and adversarial thresholds: wrong with probability 1 - confidence at most."""
    mdp, n, confidence = coordination_mdp(), 12, 0.8
    wrong, decided = 0, set()
    for theta in ([1.0, -1.0, 0.0, 0.0, 0.0, 0.0], [0.5, 0.5, -0.5, -0.5, 0.0, 0.0]):
        theta = torch.tensor(theta, dtype=torch.float64)
        norm, lowest = mdp.gradient(theta).norm(), torch.linalg.eigvalsh(mdp.hessian(theta))[0]
        model = tabular(mdp, theta, n_envs=10)
        model.get_env().seed(0)
        for seed in range(n):
            report = certify_sosp(model, 40, confidence=confidence, seed=seed)
            asked = [(report.epsilon, report.rho), *thresholds_of_an_adversary(report)]
            answers = [replace(report, epsilon=e, rho=r) for e, r in asked]
            decided |= {answer.verdict for answer in answers}
            wrong += any(
                answer.verdict not in ("undecided", truth(norm, lowest, answer))
                for answer in answers
            )
    assert decided >= {"sosp", "saddle", "not stationary"}
    assert wrong <= binom.ppf(1 - 1e-4, 2 * n, 1 - confidence)


def truth(norm, lowest, report):
    if norm > report.epsilon:
        return "not stationary"
    return "sosp" if lowest >= report.curvature_threshold else "saddle"


def test_undecided_says_how_many_episodes_would_decide():
    few = certify_sosp(saddle(), 40, epsilon=0.3, rho=1.0, seed=0)
    assert few.verdict == "undecided"
    needed = few.episodes_to_decide
    assert f"about {needed:,} episodes would decide" in str(few)
    many = certify_sosp(saddle(n_envs=20), 2 * needed, epsilon=0.3, rho=1.0, seed=0)
    assert 40 < needed < 4000
    assert many.verdict == "saddle"
    assert many.episodes_to_decide is None
    assert "would decide" not in str(many)


def test_progress_is_shown_on_demand(capsys):
    plain = certify_sosp(saddle(), 4, 0.5, seed=0)
    assert "episodes" not in "".join(capsys.readouterr())
    shown = certify_sosp(saddle(), 4, 0.5, seed=0, progress_bar=True)
    assert shown.spectrum.leftmost.shape == plain.spectrum.leftmost.shape
    text = "".join(capsys.readouterr())
    assert "4/4" in text
    assert "Hessian products" in text


def test_a_missing_progress_bar_is_told_before_anything_is_simulated(monkeypatch):
    monkeypatch.setitem(sys.modules, "tqdm.rich", None)
    model = saddle()
    with pytest.raises(ImportError, match="tqdm and rich"):
        certify_sosp(model, 4, 0.5, progress_bar=True)
    assert model._last_obs is None


@pytest.mark.parametrize(
    "actions",
    [
        spaces.Discrete(3),
        spaces.Box(-1.0, 1.0, (2,)),
        spaces.MultiDiscrete([2, 3]),
        spaces.MultiBinary(2),
    ],
    ids=lambda space: type(space).__name__,
)
@pytest.mark.parametrize("is_dict", [False, True])
def test_every_space(actions, is_dict):
    box = spaces.Box(-1.0, 1.0, (3,))
    observations = spaces.Dict({"x": box, "n": spaces.Discrete(3)}) if is_dict else box
    policy = "MultiInputPolicy" if is_dict else "MlpPolicy"
    model = PPO(policy, Sampler(observations, actions), device="cpu", n_steps=8, batch_size=8)
    report = certify_sosp(model, 6, seed=0)
    assert np.isfinite(report.lambda_min.estimate)
    assert 0.0 < report.epsilon < np.inf
    assert 0.0 < report.rho < np.inf
    assert len(report.spectrum.leftmost) == 5


def test_a_network_of_thousands_of_parameters_is_judged_by_products():
    model = PPO("MlpPolicy", "CartPole-v1", device="cpu", seed=0)
    report = certify_sosp(model, 10, epsilon=1.0, n_eigenvalues=3, seed=0)
    assert len(report.gradient) == 4610
    v = report.escape_direction
    estimate = CRPN(
        "MlpPolicy", "CartPole-v1", device="cpu", seed=0, **{**PAPER, "hessian_estimator": "causal"}
    ).estimate_curvature(2)
    assert estimate.hessian.shape == (len(v), len(v))
    assert len(report.spectrum.leftmost) == 3


def test_the_same_seed_gives_the_same_certificate():
    def certificate(seed):
        model = saddle()
        model.get_env().seed(0)
        return certify_sosp(model, 20, epsilon=0.5, seed=seed)

    first, second, other = certificate(1), certificate(1), certificate(2)
    assert first.lambda_min == second.lambda_min
    assert torch.equal(first.gradient, second.gradient)
    assert not torch.equal(first.gradient, other.gradient)


def test_the_model_is_left_as_it_was():
    env = VecNormalize(DummyVecEnv([lambda: gym.make("CartPole-v1")]))
    model = PPO("MlpPolicy", env, seed=0, device="cpu", n_steps=64)
    before = [p.clone() for p in model.policy.parameters()]
    state, mean = torch.get_rng_state(), model.env.obs_rms.mean.copy()
    model.policy.set_training_mode(True)
    certify_sosp(model, 4, epsilon=1.0)
    assert model.policy.training
    assert model.env.training
    assert all(map(torch.equal, before, model.policy.parameters()))
    assert torch.equal(state, torch.get_rng_state())
    np.testing.assert_array_equal(mean, model.env.obs_rms.mean)
    model.learn(64)


@pytest.mark.parametrize(
    "wrong",
    [
        {"n_episodes": 3},
        {"epsilon": 0.0},
        {"rho": -1.0},
        {"confidence": 1.0},
        {"interval": "normal"},
        {"interval": "bernstein"},
        {"bounds": (1.0, 1.0)},
        {"n_eigenvalues": 0},
        {"n_probes": 0},
    ],
    ids=str,
)
def test_wrong_arguments_are_named(wrong):
    arguments = {"n_episodes": 4, "epsilon": 1.0, **wrong}
    (name,) = wrong
    with pytest.raises(ValueError, match="bounds" if name == "interval" == "bernstein" else "="):
        certify_sosp(saddle(), **arguments)


def test_an_endless_episode_is_an_error(monkeypatch):
    monkeypatch.setattr("sb3_crpn.episodes.collector.ENDLESS", 30)
    endless = Sampler(spaces.Box(-1.0, 1.0, (2,)), spaces.Discrete(2), length=10**9)
    model = PPO("MlpPolicy", endless, device="cpu")
    with pytest.raises(ValueError, match="no episode ended within 30 steps"):
        certify_sosp(model, 4, 1.0)
    horizon = CRPN("MlpPolicy", endless, device="cpu", horizon=5)
    assert certify_sosp(horizon, 4, 1.0).n_steps == 20
