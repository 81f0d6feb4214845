"""A critic of the network's features, on decision processes whose derivatives are known."""

from functools import partial

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import torch

from benchmarks.exact import expected_causal_hessian, random_mdp
from benchmarks.experiments import gradient_critic, network_critic, oracle
from benchmarks.experiments.critic_hessian import (
    CriticHessian,
    LinearCritic,
    ScoredEpisodes,
    critic_features,
    cross_fitted_forms,
    fit_critic,
)
from benchmarks.experiments.cross_time import Chain, Steps
from sb3_crpn.algorithm.update import UpdateData
from sb3_crpn.curvature import Causal
from sb3_crpn.curvature.derivatives import EpisodeDerivatives
from sb3_crpn.episodes.batch import episode_starts
from tests.benchmarks.experiments.learner import KAPPA, MDP, THETA, make_learner
from tests.mdp import differs

EYE = torch.eye(len(THETA), dtype=torch.float64)


@pytest.fixture(scope="module")
def model():
    return make_learner(n_envs=50)


@pytest.fixture(scope="module")
def batch(model):
    return model.estimate_curvature(400).gradient_batch


def project(model, batch, basis=EYE):
    return ScoredEpisodes(model.policy, model.actor, batch).project(basis)


@pytest.fixture(scope="module")
def steps(model, batch):
    return project(model, batch)


@pytest.fixture
def arbitrary(steps):
    """A critic that knows nothing."""
    shape = steps.features.shape[1], steps.scores.shape[1]
    return LinearCritic(*np.random.default_rng(0).normal(size=(2, *shape)))


@pytest.mark.parametrize("kappa", [0.0, 0.9, 1.0])
def test_without_a_critic_h_is_that_of_the_package(model, batch, steps, kappa):
    package = EpisodeDerivatives(model.policy, model.actor, batch, Causal(kappa))
    expected = package.quadratic_form(EYE) * batch.size
    torch.testing.assert_close(steps.form(kappa), expected, rtol=1e-4, atol=1e-3)


def test_a_critic_of_zero_changes_nothing_but_the_decay(steps):
    critic = fit_critic([steps], KAPPA, ridge=1e12)
    for trace in (0.5, 1.0):
        found = steps.form(KAPPA, trace, critic)
        torch.testing.assert_close(found, steps.form(KAPPA * trace), rtol=1e-7, atol=1e-7)


def test_forms_are_symmetric_and_those_of_the_basis(model, batch, steps, arbitrary):
    basis = torch.from_numpy(np.random.default_rng(1).normal(size=(len(THETA), 3)))
    projected = project(model, batch, basis)
    critic = LinearCritic(arbitrary.values @ basis.numpy(), arbitrary.baseline @ basis.numpy())
    found, whole = projected.form(KAPPA, 0.5, critic), steps.form(KAPPA, 0.5, arbitrary)
    assert torch.equal(found, found.T)
    torch.testing.assert_close(found, basis.T @ whole @ basis, rtol=1e-4, atol=1e-3)


def test_cross_time_terms_by_their_definition(model, batch, arbitrary):
    trace, few = 0.5, project(model, batch.take(np.arange(20)))
    b, c = few.features @ arbitrary.values, few.features @ arbitrary.baseline
    expected = few.at_once.copy()
    for start, length in zip(episode_starts(few.lengths), few.lengths, strict=True):
        own = slice(start, start + length)
        following = KAPPA * np.append(b[own][1:], np.zeros((1, b.shape[1])), axis=0)
        errors = few.rewards[own] + following - b[own]
        for i in range(length):
            weights = (KAPPA * trace) ** np.arange(1, length - i)
            returns = following[i] - c[start + i] + weights @ errors[i + 1 :]
            pairs = np.outer(few.scores[start + i], returns)
            expected += pairs + pairs.T
    np.testing.assert_allclose(few.form(KAPPA, trace, arbitrary), expected, atol=1e-9)


def test_the_critic_of_one_hot_features_is_that_of_the_tables():
    mdp = random_mdp(1, horizon=200, gamma=1.0, concentration=0.3, max_stop=0.4)
    theta = torch.linspace(-1.0, 1.0, mdp.n_parameters, dtype=torch.float64)
    learner = gradient_critic.make_model(mdp, theta, 1)
    episodes = learner.estimate_curvature(500).gradient_batch
    chain = Chain(mdp, learner.actor.vector)
    expected = Steps.of(chain, episodes).fit(KAPPA, len(mdp.initial))
    projected = project(learner, episodes, torch.eye(len(chain.theta), dtype=torch.float64))
    critic = fit_critic([projected], KAPPA, ridge=1e-9)
    states = np.append(np.eye(len(mdp.initial)), np.ones((len(mdp.initial), 1)), axis=1)
    np.testing.assert_allclose(states @ critic.values, expected.values, atol=1e-4)
    np.testing.assert_allclose(states @ critic.baseline, expected.baseline, atol=1e-4)


def test_features_are_what_values_are_linear_in():
    for algorithm in (oracle.CRPN, CriticHessian):
        model = algorithm("MlpPolicy", "CartPole-v1", seed=0, device="cpu")
        observations = torch.randn(5, 4, generator=torch.Generator().manual_seed(0))
        layer = model.policy.value_net
        weights = torch.cat([layer.weight.T, layer.bias[None]]).detach().double()
        values = torch.from_numpy(critic_features(model.policy, observations)) @ weights
        expected = model.policy.predict_values(observations).detach().double()
        torch.testing.assert_close(values, expected, rtol=1e-5, atol=1e-5)


def test_cross_fitted_forms_keep_the_expectation_of_h_as_a_baseline(model):
    expected = expected_causal_hessian(MDP, THETA, KAPPA)
    samples = {}
    pairs = model.estimate_curvature(1600).gradient_batch.split(100)
    folds = [[project(model, part) for part in pair.split(2)] for pair in pairs]
    for trace in (1.0, 0.0):
        forms = [cross_fitted_forms(parts, KAPPA, trace).sum(0) / 16 for parts in folds]
        samples[trace] = torch.stack(forms)
    assert not differs(samples[1.0], expected)
    assert differs(samples[1.0], expected + 0.3)
    spread = {trace: float(found.var(0).sum()) for trace, found in samples.items()}
    assert spread[0.0] < spread[1.0]


def test_the_critic_of_an_update_is_that_of_the_other_fold():
    model = make_learner(CriticHessian)
    batch, earlier = (model.estimate_curvature(n).gradient_batch for n in (6, 5))
    estimate = model._estimate(UpdateData(batch, [earlier]))
    first, second = estimate.gradient_batch.split(2)
    assert (first.n_episodes, second.n_episodes) == (6, 5)
    basis = EYE[:, :3]
    one, other = (project(model, part, basis) for part in (first, second))
    form = partial(other.form, KAPPA, 0.5)
    found = estimate.hessian.group_forms(basis)
    torch.testing.assert_close(found[1], form(fit_critic([one], KAPPA)) / 5)
    assert not torch.allclose(found[1], form(None) / 5)
    assert estimate.hessian.weights.tolist() == pytest.approx([6 / 11, 5 / 11])


def test_without_another_fold_there_is_no_critic():
    model = make_learner(CriticHessian)
    batch = model.estimate_curvature(1).gradient_batch
    estimate = model._estimate(UpdateData(batch, []))
    plain = EpisodeDerivatives(model.policy, model.actor, batch, Causal(KAPPA))
    found = estimate.hessian.group_forms(EYE)[0]
    torch.testing.assert_close(found, plain.quadratic_form(EYE), rtol=1e-4, atol=1e-4)


def test_products_are_refused():
    model = make_learner(CriticHessian)
    batch = model.estimate_curvature(2).gradient_batch
    hessian = model._estimate(UpdateData(batch, [])).hessian
    with pytest.raises(NotImplementedError, match="metric='fisher'"):
        hessian @ EYE[0]


def test_the_oracle_study_trains_with_the_critic(monkeypatch):
    monkeypatch.setattr(oracle, "TASKS", {"CartPole-v1": oracle.Task(1200)})
    rows = [oracle.measure("CartPole-v1", 0.02, name, 0)[0] for name in ("own", "critic")]
    own, critic = (row["mean_return"] for row in rows)
    assert 10 < critic < 100
    assert own != critic


def test_estimates_use_their_batch_and_the_next():
    assert np.flatnonzero(network_critic.uses(6, 2)[5]).tolist() == [0, 1, 5]
    assert (network_critic.uses(24, 6).sum(1) == 7).all()


@pytest.mark.parametrize("fit", [0, 3])
def test_moments_are_those_of_the_distribution(fit):
    """H_i = a R + b (noise of i) + c (mean noise of its critic's batches), and an error."""
    generator, n, d = np.random.default_rng(0), 24, 30
    truth, error = np.ones(d), np.resize([0.5, -0.5], d)
    found = []
    for _ in range(200):
        noise = generator.normal(size=(n, d))
        others = network_critic.uses(n, fit) & ~np.eye(n, dtype=bool)
        shared = (others @ noise) / max(fit, 1)
        estimates = 0.8 * truth + error + 0.6 * noise + shared
        found.append(network_critic.moments(estimates, truth + noise, fit))
    means = pd.DataFrame(found).mean()
    variance = 0.36 + (1.0 / fit if fit else 0.0)
    assert means["square"] == pytest.approx(0.64 + 0.25 + variance, rel=0.03)
    assert means.mean_square == pytest.approx(0.64 + 0.25, rel=0.03)
    assert means.slope == pytest.approx(0.8, rel=0.03)
    assert means.bias == pytest.approx((0.04 + 0.25) ** 0.5, rel=0.03)


def test_the_scaled_error_is_the_lowest_of_all_multiples():
    rows = pd.DataFrame([{"square": 2.0, "mean_square": 1.2, "slope": 0.9}])
    omegas = np.linspace(0.0, 2.0, 20_001)
    for more, square in ((1, 2.0), (2, 1.6)):
        found = network_critic.with_errors(rows, more).iloc[0]
        errors = omegas**2 * square - 2.0 * omegas * 0.9 + 1.0
        assert found.error == pytest.approx(errors[10_000])
        assert found.scaled == pytest.approx(min(errors))
        assert found.omega == pytest.approx(omegas[errors.argmin()], abs=1e-4)


def test_the_errors_at_a_checkpoint_are_measured(monkeypatch):
    monkeypatch.setattr(network_critic, "TASKS", {"CartPole-v1": network_critic.Task(600, 4)})
    monkeypatch.setattr(network_critic, "N_BATCHES", 12)
    monkeypatch.setattr(network_critic, "FITS", (1, 3))
    jobs = network_critic.jobs(1)
    assert jobs == [{"env": "CartPole-v1", "seed": 10}]
    rows = pd.DataFrame([jobs[0] | row for row in network_critic.measure(**jobs[0])])
    assert len(rows) == 7 + 2 * 2
    found = rows.set_index(["fit", "kappa", "trace"])
    assert found.bias[0, 0.9, 1.0] == 0.0
    assert found.slope[0, 0.9, 1.0] == pytest.approx(1.0)
    assert found.square[0, 1.0, 1.0] > found.square[0, 0.9, 1.0] > found.square[0, 0.0, 1.0]
    plt.close(network_critic.draw(rows))
