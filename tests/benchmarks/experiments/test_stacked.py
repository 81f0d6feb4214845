import numpy as np
import pandas as pd
import pytest
import torch
from scipy.optimize import nnls

from benchmarks.exact import TabularVectorEnv, assign_actor, random_mdp
from benchmarks.experiments import stacked
from benchmarks.experiments.stacked import (
    MIN_UPDATES,
    ProductMeans,
    StackedCRPN,
    joined_products,
    regression_weights,
    step_factors,
)
from benchmarks.experiments.tasks import make_model
from sb3_crpn import CRPN, PAPER
from sb3_crpn.algorithm.update import UpdateData
from sb3_crpn.curvature import Causal
from sb3_crpn.curvature.derivatives import EpisodeDerivatives
from sb3_crpn.vec_env import GymnasiumVecEnv

MDP = random_mdp(0)
DAMPING = 0.1


@pytest.fixture
def learner():
    """A model, and its fresh and two earlier rollouts, the oldest first."""
    model = StackedCRPN(
        "MlpPolicy", GymnasiumVecEnv(TabularVectorEnv(MDP, 8)), device="cpu", seed=0,
        **PAPER | {"metric": "fisher", "hessian_estimator": "causal", "n_reused_rollouts": 2,
                   "n_steps": MDP.horizon, "gamma": MDP.gamma, "policy_kwargs": {"net_arch": []}},
    )  # fmt: skip
    assign_actor(model.policy, torch.linspace(-1.0, 1.0, MDP.n_parameters, dtype=torch.float64))
    fresh, newer, older = (model.estimate_curvature(n).gradient_batch for n in (16, 24, 8))
    return model, UpdateData(fresh, [older, newer])


def derivatives(model, batch):
    return EpisodeDerivatives(model.policy, model.actor, batch, Causal(model.hessian_lambda))


@pytest.mark.parametrize("seed", range(3))
def test_weights_are_the_non_negative_least_squares_solution(seed):
    rng = np.random.default_rng(seed)
    gradients, target = rng.normal(size=(4, 9)), rng.normal(size=9)
    weights = regression_weights(gradients @ gradients.T, gradients @ target)
    np.testing.assert_allclose(weights, nnls(gradients.T, target)[0], atol=1e-8)


def test_equal_gradients_and_no_gradients_do_no_harm():
    weights = regression_weights(np.ones((2, 2)), np.ones(2))
    assert weights.sum() == pytest.approx(1.0, rel=1e-6)
    assert regression_weights(np.zeros((0, 0)), np.zeros(0)).shape == (0,)


def test_means_are_plain_at_first_and_then_fade():
    means, expected = ProductMeans(1), 0.0
    for value in range(20):  # the weights w = c/G of one rollout are its means
        means.update(np.eye(1), np.array([float(value)]))
        if value + 1 >= MIN_UPDATES:
            expected = value / 2 if value < 10 else 0.9 * expected + 0.1 * value
            assert means.weights(1) == pytest.approx([expected])


def test_a_rollout_without_statistics_has_no_weight_yet():
    means = ProductMeans(2)
    for update in range(2 * MIN_UPDATES):
        k = 1 if update < MIN_UPDATES + 1 else 2
        means.update(np.eye(k), np.ones(k))
        assert len(means.weights(3)) == (update + 1 >= MIN_UPDATES)
    means.update(np.eye(2), np.ones(2))
    assert len(means.weights(3)) == 2
    assert len(means.weights(1)) == 1


def test_rollouts_are_weighted_by_their_precision_and_pure_noise_not_at_all():
    rng = np.random.default_rng(0)
    d = 4000
    truth, variances = rng.normal(size=d) / d**0.5, np.array([2.0, 2.0, 0.5])
    means = ProductMeans(3)
    for _ in range(20):
        noise = rng.normal(size=(5, d)) / d**0.5
        halves = truth + (2 * variances[0]) ** 0.5 * noise[:2]
        earlier = truth + variances[1:, None] ** 0.5 * noise[2:4]
        gradients = np.vstack([halves, earlier, noise[4:]])
        means.update(*joined_products(gradients @ gradients.T, np.array([50.0, 50.0])))
    weights = means.weights(4)
    expected = (1 / variances) / (1 + (1 / variances).sum())  # of a truth of norm 1
    np.testing.assert_allclose(weights[:3], expected, atol=0.03)
    assert weights[3] < 0.03


def test_equal_weights_per_step_are_those_of_crpn():
    np.testing.assert_allclose(step_factors(np.array([0.2, 0.1, 0.3]), [400, 200, 600]), 1.0)
    np.testing.assert_array_equal(step_factors(np.zeros(2), [400, 200, 600]), 1.0)
    np.testing.assert_array_equal(step_factors(np.zeros(0), [400, 200]), 1.0)


def test_factors_have_a_mean_of_one_and_a_rollout_without_weight_keeps_one():
    sizes = np.array([400, 200, 600])
    factors = step_factors(np.array([0.1, 0.2]), sizes)
    assert factors @ sizes == pytest.approx(sizes.sum())
    assert factors[1] == pytest.approx(4 * factors[0])
    assert factors[2] == 1.0


def test_products_are_those_of_the_inverse_metric(learner):
    model, data = learner
    for _ in range(MIN_UPDATES):
        model._observe([data.fresh, *data.earlier])
    groups = [derivatives(model, batch) for batch in (data.fresh, *data.earlier)]
    gradients = torch.stack([group.gradient() for group in groups])
    n = gradients.shape[1]
    fisher = torch.stack([groups[0].fisher_product(e) for e in torch.eye(n).double()])
    metric = fisher + DAMPING * torch.eye(n).double()
    gram = gradients @ torch.linalg.solve(metric, gradients.T)
    expected = (gram / gram[0, 0]).numpy()
    np.testing.assert_allclose(model._means._gram, expected, rtol=0.01, atol=0.01)
    np.testing.assert_allclose(model._means._target[1:], expected[0, 1:], rtol=0.01, atol=0.01)
    A, B = (derivatives(model, half).gradient() for half in data.fresh.split(2))
    product = float(A @ torch.linalg.solve(metric, B) / gram[0, 0])
    assert model._means._target[0] == pytest.approx(product, rel=0.01, abs=0.01)


def test_gradient_and_hessian_have_the_weights(learner, monkeypatch):
    model, data = learner
    weights = np.array([0.5, 0.2, 0.1])
    monkeypatch.setattr(ProductMeans, "weights", lambda *_: weights)
    estimate = model._estimate(data)
    np.testing.assert_allclose(model.shares[-1], weights / weights.sum())
    groups = [derivatives(model, batch) for batch in (data.fresh, *data.earlier[::-1])]
    shares = torch.from_numpy(weights / weights.sum())
    gradient = shares @ torch.stack([group.gradient() for group in groups])
    torch.testing.assert_close(estimate.gradient, gradient, rtol=1e-4, atol=1e-6)
    vector = torch.linspace(-1.0, 2.0, len(gradient), dtype=torch.float64)
    product = shares @ torch.stack([group.hessian_product(vector) for group in groups])
    torch.testing.assert_close(estimate.hessian @ vector, product, rtol=1e-4, atol=1e-6)


def trained(algorithm, **attributes):
    model = make_model("CartPole-v1", 0, algorithm, n_steps=32, n_reused_rollouts=2)
    vars(model).update(attributes)
    return model.learn(600).policy.state_dict()


def test_equal_weights_are_crpn_bit_for_bit_and_others_are_not():
    expected = trained(CRPN)
    equal, weighted = trained(StackedCRPN, stacked=False), trained(StackedCRPN)
    assert all(torch.equal(equal[name], value) for name, value in expected.items())
    assert any(not torch.equal(weighted[name], value) for name, value in expected.items())


def test_a_training_run_is_measured(monkeypatch):
    monkeypatch.setitem(stacked.BUDGETS, "CartPole-v1", 800)
    (row,) = stacked.measure("CartPole-v1", 3, "stacked", 10)
    assert 15 < row["mean_return"] < 60  # the uniform policy's is 22
    assert len(row["shares"]) == 4
    assert sum(row["shares"]) == pytest.approx(1.0)


def test_the_tables_have_the_differences_by_seed_and_the_shares():
    rows = pd.DataFrame(
        [
            {"env": "CartPole-v1", "n_reused_rollouts": 8, "arm": arm, "seed": seed}
            | {"mean_return": 100 * seed + gain, "late_return": gain, "mean_reused": 2.5}
            | {"shares": f"[0.{4 + seed}, 0.{6 - seed}, 0.0, 0.0]"}
            for seed in (1, 2)
            for arm, gain in (("equal", 0), ("stacked", 7))
        ]
    )
    last = stacked.table(rows).splitlines()[-1]
    assert last.startswith("| CartPole-v1 | 8 | 2 | 150 [100, 200] | 157 [107, 207] | +7 [+7, +7]")
    assert "| equal | 2.5 | 2.0 | 0.55 0.45 0.00 0.00 |" in stacked.shares_table(rows)
    figure = stacked.draw(rows)
    assert [axis.get_title() for axis in figure.axes[:3]] == list(stacked.BUDGETS)
