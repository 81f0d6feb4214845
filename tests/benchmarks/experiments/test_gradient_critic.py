import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import torch
from torch.autograd.functional import jacobian

from benchmarks.exact import expected_causal_hessian, random_mdp
from benchmarks.experiments import gradient_critic
from benchmarks.experiments.cross_time import Chain, Critic, Steps, hessians, next_values
from sb3_crpn.curvature import Causal
from sb3_crpn.curvature.derivatives import EpisodeDerivatives
from sb3_crpn.episodes.batch import episode_starts
from tests.mdp import differs

SEED, N = 1, 2000


@pytest.fixture(scope="module")
def mdp():
    return random_mdp(SEED, horizon=200, gamma=1.0, concentration=0.3, max_stop=0.4)


@pytest.fixture(scope="module")
def model(mdp):
    theta = torch.linspace(-1.0, 1.0, mdp.n_parameters, dtype=torch.float64)
    return gradient_critic.make_model(mdp, theta, SEED)


@pytest.fixture(scope="module")
def chain(mdp, model):
    return Chain(mdp, model.actor.vector)


@pytest.fixture(scope="module")
def batch(model):
    return model.estimate_curvature(N).gradient_batch


@pytest.fixture
def arbitrary(mdp):
    """A critic that knows nothing."""
    return Critic(*np.random.default_rng(0).normal(size=(2, len(mdp.initial), mdp.n_parameters)))


@pytest.mark.parametrize("kappa", [0.0, 0.9, 1.0])
def test_a_baseline_keeps_the_expectation(mdp, chain, arbitrary, kappa):
    expected = expected_causal_hessian(mdp, chain.theta, kappa)
    np.testing.assert_allclose(chain.expected(arbitrary, kappa, 1.0), expected, atol=1e-9)


@pytest.mark.parametrize("trace", gradient_critic.TRACES)
def test_with_the_exact_critic_no_trace_is_biased(mdp, chain, trace):
    truth = mdp.hessian(chain.theta)
    np.testing.assert_allclose(chain.expected(chain.critic(1.0), 1.0, trace), truth, atol=1e-9)


def test_the_exact_critic_is_the_gradient_of_the_cost_to_go(mdp, chain):
    gradients = -jacobian(lambda at: mdp.values(at)[0], chain.theta)
    np.testing.assert_allclose(chain.critic(1.0).values, gradients, atol=1e-9)


def test_without_a_critic_h_is_that_of_the_package(model, chain, batch):
    steps = Steps.of(chain, batch)
    zero = np.zeros((chain.scores.shape[0], chain.scores.shape[2]))
    found = hessians(steps, steps.crossed(1.0, 0.9, len(zero)), Critic(zero, zero)).mean(0)
    package = EpisodeDerivatives(model.policy, model.actor, batch, Causal(0.9))
    expected = package.quadratic_form(torch.eye(found.shape[0], dtype=torch.float64))
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(("kappa", "trace"), [(1.0, 0.0), (0.9, 0.5), (1.0, 1.0)])
def test_episodes_have_their_expectation_with_any_critic(chain, batch, arbitrary, kappa, trace):
    steps = Steps.of(chain, batch)
    crossed = steps.crossed(kappa, trace, len(arbitrary.values))
    samples = hessians(steps, crossed, arbitrary)
    assert not differs(samples, chain.expected(arbitrary, kappa, trace))
    assert differs(samples, chain.expected(chain.critic(kappa), kappa, trace)) == (trace < 1.0)


def test_returns_by_their_definition(chain, batch, arbitrary):
    kappa, trace, (b, c) = 0.9, 0.5, vars(arbitrary).values()
    n_episodes = 20
    steps = Steps.of(chain, batch.take(np.arange(n_episodes)))
    expected = []
    for start, length in zip(episode_starts(steps.lengths), steps.lengths, strict=True):
        own = slice(start, start + length)
        values = np.append(b[steps.states[own]], np.zeros((1, b.shape[1])), axis=0)
        errors = steps.rewards[own] + kappa * values[1:] - values[:-1]
        expected += [
            kappa * values[i + 1]
            - c[steps.states[start + i]]
            + sum((kappa * trace) ** (j - i) * errors[j] for j in range(i + 1, length))
            for i in range(length)
        ]
    found = steps.returns(kappa, trace, len(b)) @ arbitrary.coefficients
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_lstd_leaves_no_error_on_its_own_steps(chain, batch):
    kappa, n_states = 0.9, len(chain.scores)
    steps = Steps.of(chain, batch)
    critic = steps.fit(kappa, n_states)
    features = np.eye(n_states)[steps.states]
    following = kappa * next_values(critic.values[steps.states], steps.lengths)
    errors = steps.rewards + following - critic.values[steps.states]
    np.testing.assert_allclose(features.T @ errors, 0.0, atol=1e-8)
    advantages = following - critic.baseline[steps.states]
    np.testing.assert_allclose(features.T @ advantages, 0.0, atol=1e-8)


def test_the_scaled_error_is_the_lowest_of_all_multiples():
    truth, mean = np.array([[2.0, 0.0], [0.0, 1.0]]), np.array([[1.0, 0.5], [0.5, 1.0]])
    noise = np.random.default_rng(0).normal(size=(500, 2, 2))
    row = gradient_critic.moments([(mean, mean + noise)], truth) | {"episodes": 10}
    found = gradient_critic.with_errors(pd.DataFrame([row])).iloc[0]
    variance = noise.var(0, ddof=1).sum() / 10
    errors = [
        (((omega * mean - truth) ** 2).sum() + omega**2 * variance) / (truth**2).sum()
        for omega in np.linspace(0.0, 2.0, 20_001)
    ]
    assert found.error == pytest.approx(errors[10_000])
    assert found.scaled == pytest.approx(min(errors))


def test_the_errors_of_an_mdp_are_measured(monkeypatch):
    monkeypatch.setattr(gradient_critic, "HORIZON", 60)
    monkeypatch.setattr(gradient_critic, "STOPS", (0.4,))
    monkeypatch.setattr(gradient_critic, "EPISODES", (50,))
    monkeypatch.setattr(gradient_critic, "N_EVALUATED", 500)
    rows = pd.DataFrame([{"stop": 0.4, "seed": 0} | row for row in gradient_critic.measure(0.4, 0)])
    found = gradient_critic.with_errors(rows).set_index(["critic", "kappa", "trace"])
    assert len(found) == len(gradient_critic.KAPPAS) + 2 * 4 * 4
    assert found.bias["none", 1.0, 1.0] == pytest.approx(0.0, abs=1e-6)
    assert found.bias["none", 0.0, 1.0] > 0.1
    assert found.squared_bias["3x", 1.0, 0.0] < found.squared_bias["1x", 1.0, 0.0]
    assert found.variance["3x", 1.0, 0.0] < found.variance["none", 1.0, 1.0]
    plt.close(gradient_critic.draw(rows))
