import numpy as np
import pytest
import torch
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.exact import TabularEnv, random_mdp
from benchmarks.experiments import reuse, reuse_training
from sb3_crpn import CRPN
from sb3_crpn.curvature import Causal
from sb3_crpn.curvature.derivatives import EpisodeDerivatives
from sb3_crpn.episodes.batch import episode_starts

KL = 0.02
WEIGHTING = {"baseline": True, "normalize_advantage": False, "discount_visitation": False}


@pytest.fixture(scope="module")
def reused():
    """A model after a step, the MDP, its θ, and the episodes from before."""
    mdp = random_mdp(0, horizon=reuse.HORIZON, gamma=1.0, concentration=0.3, max_stop=0.4)
    theta = torch.linspace(-1.0, 1.0, mdp.n_parameters, dtype=torch.float64)
    env = make_vec_env(lambda: TabularEnv(mdp), 50, seed=0)
    model = CRPN(
        "MlpPolicy", env, gamma=1.0, normalize_advantage=False, hessian_lambda=reuse.KAPPA,
        policy_kwargs={"net_arch": []}, seed=0, device="cpu",
    )  # fmt: skip
    reuse.assign(model, mdp, theta)
    episodes = model.estimate_curvature(2000).gradient_batch
    theta = theta + reuse.natural_step(mdp, theta, KL)
    reuse.assign(model, mdp, theta)
    return model, mdp, theta, episodes


def test_a_step_has_its_divergence(reused):
    model, _, _, episodes = reused
    _, ratios = reuse.reweighted(model, episodes)
    # E_μ[ρ - 1 - log ρ] = KL(μ ‖ π)
    assert np.mean(ratios - 1.0 - np.log(ratios)) == pytest.approx(KL, rel=0.1)


def test_derivatives_in_closed_form_are_those_of_the_package(reused):
    model, mdp, theta, episodes = reused
    batch, _ = reuse.reweighted(model, episodes)
    package = EpisodeDerivatives(model.policy, model.actor, batch, Causal(reuse.KAPPA))
    own = reuse.Derivatives(mdp, theta, batch)
    gradient, hessian = own.gradients.mean(0), own.hessians.mean(0)
    np.testing.assert_allclose(gradient, package.gradient(), rtol=1e-3, atol=1e-4)
    basis = torch.eye(len(theta), dtype=torch.float64)
    np.testing.assert_allclose(hessian, package.quadratic_form(basis), rtol=1e-3, atol=1e-3)


def test_fresh_episodes_have_no_bias_and_both_ratios_the_least(reused, monkeypatch):
    model, mdp, theta, episodes = reused
    monkeypatch.setattr(reuse, "N_EPISODES", 2000)
    rows = {row["arm"]: row for row in reuse.errors(model, mdp, theta, episodes)}
    assert set(rows) == {"fresh", *reuse.ARMS}
    noise = {arm: row["variance_H"] / 2000 for arm, row in rows.items()}
    assert abs(rows["fresh"]["bias_H"]) < 3 * noise["fresh"]
    assert (
        rows["both actions"]["bias_H"] + 3 * noise["both actions"] < rows["later action"]["bias_H"]
    )


def test_pairs_have_both_ratios_and_a_step_its_own():
    A, ratios = np.array([0.5, -1.0, 2.0]), np.array([2.0, 0.5, 1.5])
    product = reuse.PairRatios(ratios).apply(A, np.array([3]), np.eye(3))
    expected = np.array(
        [
            [reuse.KAPPA ** abs(i - j) * A[max(i, j)] * (ratios[min(i, j)] if i != j else 1.0)
             for j in range(3)]
            for i in range(3)
        ]
    )  # fmt: skip
    np.testing.assert_allclose(product, expected)


@pytest.mark.parametrize("arm", list(reuse_training.ARMS))
def test_reused_steps_are_weighted_by_the_ratios_before_them(reused, arm):
    model, _, _, episodes = reused
    replay = reuse_training.replay_of(model, arm)
    replay.append(episodes)
    (batch,) = replay.reweighted(model.policy, **WEIGHTING)
    expected, ratios = reuse.reweighted(model, episodes)
    clip, decay = reuse_training.ARMS[arm]
    start = episode_starts(batch.lengths)[np.argmax(batch.lengths > 1)]
    steps = slice(start, start + 2)
    first, second = batch.cost_advantages[steps] / expected.cost_advantages[steps]
    exponent = np.clip(decay * np.log(ratios[start]), -clip, clip)
    assert second / first == pytest.approx(np.exp(exponent))
    assert (first == 1.0) == (clip == 0.0)  # weights have a mean of 1


def test_a_training_run_is_measured(monkeypatch):
    monkeypatch.setitem(reuse_training.BUDGETS, "CartPole-v1", 800)
    (row,) = reuse_training.measure("CartPole-v1", 4, "auto", "c = 1.5, κ = 1", 10)
    assert 15 < row["mean_return"] < 60  # the uniform policy's is 22
