import numpy as np
import pytest
import torch
from torch.func import jacrev

from benchmarks.exact import TabularMDP
from sb3_crpn.curvature.derivatives import EpisodeDerivatives
from sb3_crpn.episodes import EpisodeBatch
from sb3_crpn.theory import Constants, ScoreBounds, softmax_linear
from tests.mdp import random_mdp, random_parameters, tabular_crpn
from tests.policies import estimator_of, small_policy

NAMES = ["cost_bound", "M_g", "M_H", "L_H", "G_g", "G_H", "M_1", "M_2"]


def constants_of(mdp):
    """The constants of a TabularMDP with SB3's softmax policy: one-hot features and a bias."""
    K = float(mdp.reward.abs().max())
    return Constants(K, softmax_linear(1.0), mdp.horizon, mdp.n_parameters, mdp.gamma)


def two_armed_bandit():
    """Reward 1 or -1 for the one action: J = -tanh(x/2), x the difference of the logits."""
    one = torch.ones(1, dtype=torch.float64)
    reward = torch.tensor([[1.0, -1.0]], dtype=torch.float64)
    return TabularMDP(one, one.expand(1, 2, 1), reward, torch.tensor([0]), horizon=1, gamma=0.8)


def gradient(mdp, theta):
    return jacrev(mdp.cost)(theta)


def hessian(mdp, theta):
    return jacrev(jacrev(mdp.cost))(theta)


def norm(matrix):
    return float(torch.linalg.matrix_norm(matrix, 2))


def change_of_hessian(mdp, theta, direction, length):
    ahead, behind = theta + length * direction, theta - length * direction
    return norm(hessian(mdp, ahead) - hessian(mdp, behind)) / (2.0 * length)


@pytest.mark.parametrize("fixed_length", [True, False])
@pytest.mark.parametrize("horizon", [1, 4])
def test_bounds_of_the_cost_hold(horizon, fixed_length):
    generator = torch.Generator().manual_seed(0)
    for seed in range(3):
        mdp = random_mdp(seed, horizon, fixed_length=fixed_length)
        constants = constants_of(mdp)
        for scale in (0.0, 1.0, 4.0):
            theta = scale * random_parameters(mdp, seed)
            assert abs(float(mdp.cost(theta))) <= constants.cost_bound
            assert float(gradient(mdp, theta).norm()) <= constants.M_g
            assert norm(hessian(mdp, theta)) <= constants.M_H
            direction = torch.randn(len(theta), dtype=torch.float64, generator=generator)
            direction = direction / direction.norm()
            for length in (1e-3, 1.0):
                assert change_of_hessian(mdp, theta, direction, length) <= constants.L_H


def test_bounds_of_the_cost_are_not_far_off_for_a_bandit():
    mdp = two_armed_bandit()
    constants = constants_of(mdp)
    along = torch.tensor([1.0, -1.0, 1.0, -1.0], dtype=torch.float64) / 2.0
    thetas = torch.linspace(-1.5, 1.5, 61, dtype=torch.float64)[:, None] * along
    assert max(abs(float(mdp.cost(20.0 * theta))) for theta in thetas) > 0.99 * constants.cost_bound
    assert max(float(gradient(mdp, theta).norm()) for theta in thetas) > 0.49 * constants.M_g
    assert max(norm(hessian(mdp, theta)) for theta in thetas) > 0.15 * constants.M_H
    changes = [change_of_hessian(mdp, theta, along, 1e-3) for theta in thetas]
    assert max(changes) > 0.13 * constants.L_H


def episode_estimates(policy, actor, batch, estimator="trajectory"):
    """The gradient [E, d] and the Hessian [E, d, d] of each episode."""
    eye = torch.eye(len(actor), dtype=torch.float64)
    gradients, hessians = [], []
    for episode in range(batch.n_episodes):
        group = EpisodeDerivatives(
            policy, actor, batch.take(np.array([episode])), estimator_of(estimator)
        )
        gradients.append(group.gradient())
        hessians.append(torch.stack([group.hessian_product(v) for v in eye]))
    return torch.stack(gradients), torch.stack(hessians)


@pytest.mark.parametrize("estimator", ["trajectory", "causal"])
def test_estimates_of_single_episodes_hold(estimator):
    mdp = random_mdp(1, horizon=3, fixed_length=True)
    model, constants = tabular_crpn(mdp), constants_of(mdp)
    for scale in (0.3, 3.0):
        theta = scale * random_parameters(mdp)
        model.actor.assign(theta)
        batch = model.estimate_curvature(24).gradient_batch
        gradients, hessians = episode_estimates(model.policy, model.actor, batch, estimator)
        theta = model.actor.vector
        assert float(gradients.norm(dim=1).max()) <= constants.G_g
        assert max(map(norm, hessians)) <= constants.G_H
        assert float((gradients - gradient(mdp, theta)).norm(dim=1).max()) <= constants.M_1
        assert max(norm(H - hessian(mdp, theta)) for H in hessians) <= constants.M_2


def test_estimates_of_single_episodes_are_attained():
    """Improbable actions in one state, each with the reward -K: scores and costs are aligned."""
    policy, actor = small_policy("discrete", net_arch=())
    actor.assign(torch.zeros(len(actor)))
    with torch.no_grad():
        policy.action_net.weight[:, 0] = torch.tensor([-20.0, 20.0, 0.0])
    H, gamma, K = 5, 0.9, 2.0
    cost_to_go = K * np.cumsum((gamma ** np.arange(H))[::-1])[::-1]
    batch = EpisodeBatch(
        observations=torch.tensor([[1.0, 0.0]], dtype=torch.float64).repeat(H, 1),
        actions=torch.zeros(H),
        lengths=np.array([H]),
        cost_advantages=cost_to_go.copy(),
        values=np.zeros(H),
        returns=np.zeros(H),
        rewards=np.zeros(H),
        log_probs=np.zeros(H),
        next_observations=torch.zeros(1, 2, dtype=torch.float64),
        bootstrapped=np.zeros(1, dtype=bool),
        times=np.zeros(1, dtype=int),
        trajectories=np.arange(1),
    )
    gradients, hessians = episode_estimates(policy, actor, batch)
    constants = Constants(K, softmax_linear(1.0), H, len(actor), gamma)
    assert 0.999 * constants.G_g <= float(gradients[0].norm()) <= constants.G_g
    without_curvature = constants.G_g * H * constants.scores.G
    assert 0.999 * without_curvature <= norm(hessians[0]) <= constants.G_H
    assert without_curvature > 0.9 * constants.G_H


def test_errors_of_means_hold_and_fall_as_one_over_the_root():
    mdp = random_mdp(2, horizon=2)
    model, constants = tabular_crpn(mdp), constants_of(mdp)
    model.actor.assign(random_parameters(mdp))
    theta = model.actor.vector
    estimates = [model.estimate_curvature(16) for _ in range(20)]
    squares = [float((e.gradient - gradient(mdp, theta)).norm()) ** 2 for e in estimates]
    assert np.mean(squares) <= constants.gradient_error(16) ** 2
    cubes = [norm(e.hessian.to_dense() - hessian(mdp, theta)) ** 3 for e in estimates]
    assert np.mean(cubes) <= constants.hessian_error(16) ** 3
    for error in (constants.gradient_error, constants.hessian_error):
        assert error(64) == pytest.approx(error(16) / 2.0)


def test_closed_forms():
    K, G, L_1, L_2, H, gamma = 2.0, 3.0, 5.0, 7.0, 4, 0.9
    scores = ScoreBounds(G, L_1, L_2)
    S_1, S_2 = H * (H + 1) / 2, H * (H + 1) * (2 * H + 1) / 6
    S_15 = sum(n**1.5 for n in range(1, H + 1))
    expected = {
        "cost_bound": K * H,
        "M_H": K * (G**2 + L_1) * S_1,
        "L_H": K * (G**3 * S_2 + 3 * G * L_1 * S_15 + L_2 * S_1),
        "G_g": K * G * S_1,
        "G_H": K * (H * G**2 + L_1) * S_1,
    }
    undiscounted = Constants(K, scores, H, d=6)
    for name, value in expected.items():
        assert getattr(undiscounted, name) == pytest.approx(value), name
    endless = Constants(K, scores, 2000, d=6, gamma=gamma)
    assert endless.cost_bound == pytest.approx(K / (1 - gamma))
    assert endless.G_g == pytest.approx(K * G / (1 - gamma) ** 2)
    assert endless.M_g <= K * G / (1 - gamma) ** 1.5
    assert Constants(K, scores, H, d=6, gamma=0.0).G_g == K * G


@pytest.mark.parametrize("name", NAMES)
def test_units(name):
    scores, scale = ScoreBounds(1.5, 2.0, 3.0), 4.0
    plain = getattr(Constants(1.0, scores, 5, 6, 0.9), name)
    assert getattr(Constants(scale, scores, 5, 6, 0.9), name) == pytest.approx(scale * plain)
    power = {"cost_bound": 0, "M_H": 2, "G_H": 2, "M_2": 2, "L_H": 3}.get(name, 1)
    finer = ScoreBounds(1.5 * scale, 2.0 * scale**2, 3.0 * scale**3)
    assert getattr(Constants(1.0, finer, 5, 6, 0.9), name) == pytest.approx(scale**power * plain)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"K": 0.0}, r"K=0.0 is not allowed, must be a finite number in \(0, inf\)"),
        ({"H": 0}, "H=0 is not allowed, must be an integer >= 1"),
        ({"d": 2.5}, "d=2.5"),
        ({"gamma": 1.1}, r"gamma=1.1 is not allowed, must be a finite number in \[0, 1\]"),
    ],
)
def test_mistakes_are_named(arguments, message):
    settings = {"K": 1.0, "scores": softmax_linear(1.0), "H": 3, "d": 4} | arguments
    with pytest.raises(ValueError, match=message):
        Constants(**settings)


@pytest.mark.parametrize("error", ["gradient_error", "hessian_error"])
def test_errors_need_an_episode(error):
    with pytest.raises(ValueError, match="n_episodes=0"):
        getattr(Constants(1.0, softmax_linear(1.0), 3, 4), error)(0)
