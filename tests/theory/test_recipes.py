import doctest
import math
from itertools import islice

import numpy as np
import pytest
import torch
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.exact import TabularEnv
from sb3_crpn import ACRPN, PAPER, theory
from sb3_crpn.cubic import solve_dense
from sb3_crpn.theory import (
    Constants,
    Recipe,
    ScoreBounds,
    approximate_recipe,
    expectation_recipe,
    high_probability_recipe,
    softmax_linear,
)
from tests.mdp import random_mdp, tabular_crpn

BANDIT = Constants(K=1.0, scores=softmax_linear(1.0), H=1, d=8)
RECIPES = {
    "expectation": expectation_recipe,
    "high probability": lambda *args: high_probability_recipe(*args, 0.05),
    "approximate": lambda *args: approximate_recipe(*args, 0.05),
}
each = pytest.mark.parametrize("recipe", RECIPES.values(), ids=RECIPES)


class Coordination(Constants):
    """Two players who must agree, J = -tanh(x_1/2) tanh(x_2/2), x the differences of logits.

    θ = 0 is a strict saddle, ∇J = 0 and λ_min = -1/2. L_H is the Lipschitz constant of this
    problem in place of the far larger one of all two-step problems, for a tight test.
    """

    L_H = 0.71
    differences = np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]])

    def cost(self, theta):
        return -np.prod(np.tanh(self.differences @ theta / 2.0))

    def derivatives(self, theta):
        t = np.tanh(self.differences @ theta / 2.0)
        slope = (1.0 - t**2) / 2.0
        curvature = -t * slope
        gradient = -slope * t[::-1]
        hessian = -np.array(
            [[curvature[0] * t[1], slope[0] * slope[1]], [slope[0] * slope[1], curvature[1] * t[0]]]
        )
        return self.differences.T @ gradient, self.differences.T @ hessian @ self.differences


COORDINATION = Coordination(K=1.0, scores=softmax_linear(1.0, bias=False), H=2, d=4)
EPSILON = 0.3


def is_sosp(theta):
    gradient, hessian = COORDINATION.derivatives(theta)
    curvature = math.sqrt(COORDINATION.L_H * EPSILON)
    return np.linalg.norm(gradient) <= EPSILON and np.linalg.eigvalsh(hessian)[0] >= -curvature


def steps_with_errors(errors, alpha, seed):
    """Cubic steps from the saddle, with errors of these norms in g and H: (step, θ after)."""
    rng, theta = np.random.default_rng(seed), np.zeros(4)
    while True:
        gradient, hessian = COORDINATION.derivatives(theta)
        u, W = rng.normal(size=4), rng.normal(size=(4, 4))
        u, W = u / np.linalg.norm(u), (W + W.T) / np.linalg.norm(W + W.T, 2)
        noisy = (
            torch.from_numpy(gradient + errors[0] * u),
            torch.from_numpy(hessian + errors[1] * W),
        )
        step = solve_dense(*noisy, alpha)
        theta = theta + step.step.numpy()
        yield step, theta


def errors_of(recipe_errors, factor=1.0):
    c_1, c_2 = recipe_errors
    return factor * c_1 * EPSILON, factor * c_2 * math.sqrt(COORDINATION.L_H * EPSILON)


def first_short_step(seed, factor=1.0):
    """The index of the first step not longer than the recipe's threshold, and θ after it."""
    recipe = high_probability_recipe(COORDINATION, EPSILON, 0.05, initial_gap=1.0)
    steps = steps_with_errors(errors_of((3 / 64, 1 / 16), factor), recipe.kwargs["alpha"], seed)
    for number, (step, theta) in enumerate(islice(steps, recipe.n_updates), start=1):
        if float(step.step.norm()) <= recipe.sosp_step_norm:
            return number, theta
    return None, None


def test_the_first_short_step_leads_to_an_sosp():
    assert not is_sosp(np.zeros(4))
    for seed in range(10):
        number, theta = first_short_step(seed)
        assert number is not None
        assert is_sosp(theta)


def test_errors_far_beyond_the_allowed_ones_keep_steps_long():
    assert first_short_step(0, factor=20.0) == (None, None)


def test_the_approximate_algorithm_stops_at_an_sosp():
    """Both inner descents are replaced by the exact minimiser."""
    recipe = approximate_recipe(COORDINATION, EPSILON, 0.05, initial_gap=1.0)
    enough = math.sqrt(EPSILON**3 / recipe.rho) / 100.0
    for seed in range(10):
        steps = steps_with_errors(errors_of((1 / 150, 1 / 200)), recipe.kwargs["alpha"], seed)
        ends = (theta for step, theta in steps if step.predicted_decrease <= enough)
        assert is_sosp(next(islice(ends, 1)))


def descend(curvatures, gradient, ratio, n_steps):
    """Gradient descent with step 1/(20ℓ), in eigen-coordinates with ρ = ε = 1 and ℓ = ratio."""
    step = [0.0] * len(curvatures)
    rate = 1.0 / (20.0 * ratio)
    for _ in range(n_steps):
        radius = 0.5 * math.sqrt(sum(s * s for s in step))
        step = [
            s - rate * (g + (c + radius) * s)
            for s, c, g in zip(step, curvatures, gradient, strict=True)
        ]
    return np.array(step)


MODELS = {
    "saddle": ([-0.33, 150.0], [0.0, 0.0]),
    "tilted saddle": ([-0.3, 150.0], [0.01, 3.0]),
    "hard case": ([-0.33, 0.5], [0.0, 0.1]),
    "slope": ([0.0, 150.0], [0.09, 1.0]),
}


@pytest.mark.parametrize("name", MODELS)
def test_the_inner_descent_attains_nine_tenths(name):
    """The assumption of `approximate_recipe`, for models whose largest decrease is just 0.02289."""
    recipe = approximate_recipe(BANDIT, BANDIT.M_H**2 / BANDIT.L_H, 0.05)
    curvatures, gradient = np.array(MODELS[name][0]), np.array(MODELS[name][1])
    ratio = recipe.kwargs["gradient_lipschitz"] / math.sqrt(recipe.rho * recipe.epsilon)
    assert ratio == pytest.approx(150.0)
    perturbed = gradient + np.array([0.6, 0.8]) / ratio
    best = solve_dense(torch.from_numpy(perturbed), torch.diag(torch.from_numpy(curvatures)), 1.0)
    step = descend(curvatures, perturbed, ratio, recipe.kwargs["subsolver_steps"])
    norm = np.linalg.norm(step)
    decrease = -(perturbed @ step + step @ (curvatures * step) / 2 + norm**3 / 6)
    assert decrease >= 0.9 * best.predicted_decrease
    unperturbed = -(gradient @ step + step @ (curvatures * step) / 2 + norm**3 / 6)
    assert unperturbed > 1 / 100
    assert norm <= float(best.step.norm()) * (1.0 + 1e-9)


def test_fewer_inner_steps_miss_a_saddle():
    recipe = approximate_recipe(BANDIT, BANDIT.M_H**2 / BANDIT.L_H, 0.05)
    step = descend(
        [-0.33, 150.0], [0.6 / 150, 0.8 / 150], 150.0, recipe.kwargs["subsolver_steps"] // 8
    )
    assert 0.33 * step[0] ** 2 / 2 - abs(step[0]) ** 3 / 6 < 1 / 100


@each
def test_orders_in_epsilon(recipe):
    coarse, fine = (recipe(BANDIT, epsilon) for epsilon in (4e-4, 1e-4))
    logarithms = 1.0 if recipe is expectation_recipe else fine_logarithm(coarse, fine)
    assert fine.n_updates / coarse.n_updates == pytest.approx(8.0, rel=1e-3)
    m, b = "n_episodes", "n_hessian_episodes"
    assert fine.kwargs[m] / coarse.kwargs[m] == pytest.approx(16.0 * logarithms, rel=1e-3)
    assert fine.kwargs[b] / coarse.kwargs[b] == pytest.approx(4.0 * logarithms, rel=1e-3)


def fine_logarithm(coarse, fine):
    return math.log(4 * 8 * fine.n_updates / 0.05) / math.log(4 * 8 * coarse.n_updates / 0.05)


@each
def test_units(recipe):
    """Units of reward and of θ change α, ε, ℓ and the step's length, but no count."""
    scores = ScoreBounds(1.5, 2.0, 3.0)
    plain = recipe(Constants(1.0, scores, 3, 5, 0.9), 0.01)
    counts = {"n_episodes", "n_hessian_episodes", "subsolver_steps"} & plain.kwargs.keys()
    c = 4.0  # a power of 2, exact
    finer = ScoreBounds(1.5 * c, 2.0 * c**2, 3.0 * c**3)
    for other, alpha in (
        (recipe(Constants(c, scores, 3, 5, 0.9), 0.01 * c), c),
        (recipe(Constants(1.0, finer, 3, 5, 0.9), 0.01 * c), c**3),
    ):
        assert other.n_updates == pytest.approx(plain.n_updates, abs=1)
        for count in counts:
            assert other.kwargs[count] == pytest.approx(plain.kwargs[count], rel=1e-6)
        assert other.kwargs["alpha"] == pytest.approx(alpha * plain.kwargs["alpha"])
        assert other.rho == pytest.approx(alpha * plain.rho)


def test_batches_are_the_least_that_bound_the_moments():
    recipe = expectation_recipe(BANDIT, 0.5)
    m, b = recipe.kwargs["n_episodes"], recipe.kwargs["n_hessian_episodes"]
    gradient, hessian = 3 / 64 * 0.5, math.sqrt(BANDIT.L_H * 0.5) / 16
    assert BANDIT.gradient_error(m) <= gradient < BANDIT.gradient_error(m - 1)
    assert BANDIT.hessian_error(b) <= hessian < BANDIT.hessian_error(b - 1)


def test_bernstein_is_met():
    """2d exp(-n u²/2 / (σ² + M u/3)) ≤ δ/(2N), the tail with n matrices of norm M, deviation σ."""
    for epsilon in (0.5, 1e-3):
        recipe = high_probability_recipe(BANDIT, epsilon, 0.05)
        hessian = math.sqrt(BANDIT.L_H * epsilon) / 16
        for count, largest, deviation, u in (
            ("n_episodes", BANDIT.M_1, BANDIT.G_g, 3 / 64 * epsilon),
            ("n_hessian_episodes", BANDIT.M_2, BANDIT.G_H, hessian),
        ):
            exponent = recipe.kwargs[count] * u**2 / 2 / (deviation**2 + largest * u / 3)
            assert 2 * BANDIT.d * math.exp(-exponent) <= 0.05 / (2 * recipe.n_updates)


def test_fewer_updates_suffice_near_the_optimum():
    far, near = expectation_recipe(BANDIT, 0.5), expectation_recipe(BANDIT, 0.5, initial_gap=0.02)
    assert far == expectation_recipe(BANDIT, 0.5, initial_gap=2.0)
    assert near.n_updates == pytest.approx(far.n_updates / 100, abs=1)


def test_crpn_takes_the_recipe_and_simulates_its_episodes():
    mdp = random_mdp(0, horizon=2, fixed_length=True)
    constants = Constants(1.0, ScoreBounds(1.0, 1.0, 0.0), H=1, d=mdp.n_parameters, gamma=0.8)
    recipe = expectation_recipe(constants, 1.0)
    model = tabular_crpn(mdp, **recipe.kwargs).learn(1)
    assert model.horizon == 1
    assert model.alpha == recipe.kwargs["alpha"]
    assert model.logger.name_to_value["train/n_episodes"] == recipe.episodes_per_update
    assert model.num_timesteps == recipe.total_timesteps(n_envs=8) / recipe.n_updates


def test_acrpn_takes_the_recipe():
    recipe = approximate_recipe(BANDIT, 0.5, 0.05)
    env = make_vec_env(lambda: TabularEnv(random_mdp(0)), 1)
    model = ACRPN("MlpPolicy", env, device="cpu", **{**PAPER, **recipe.kwargs})
    assert model.stop_at_sosp
    assert model.alpha == recipe.rho
    assert model.gradient_lipschitz >= BANDIT.M_H


@pytest.mark.parametrize("fixed_length", [True, False])
def test_total_timesteps_suffice(fixed_length):
    mdp = random_mdp(0, horizon=3, fixed_length=fixed_length)
    kwargs = {"n_episodes": 3, "n_hessian_episodes": 5, "horizon": 3, "gamma": 0.8, "alpha": 10.0}
    recipe = Recipe(kwargs, n_updates=4, epsilon=1.0, rho=1.0)
    assert recipe.episodes_per_update == 5
    model = tabular_crpn(mdp, n_envs=2, **kwargs).learn(recipe.total_timesteps(n_envs=2))
    assert model._n_updates >= 4
    assert fixed_length == (model._n_updates == 4)


@each
@pytest.mark.parametrize("epsilon", [0.0, -1.0, float("nan"), 1e9])
def test_epsilon_is_checked(recipe, epsilon):
    limit = f"{BANDIT.M_H**2 / BANDIT.L_H:g}"
    with pytest.raises(ValueError, match=rf"epsilon=.* must be a finite number in \(0, {limit}\]"):
        recipe(BANDIT, epsilon)


@pytest.mark.parametrize("recipe", [high_probability_recipe, approximate_recipe])
@pytest.mark.parametrize("probability", [0.0, 1.0, float("nan")])
def test_failure_probability_is_checked(recipe, probability):
    with pytest.raises(ValueError, match=r"failure_probability=.* a finite number in \(0, 1\)"):
        recipe(BANDIT, 0.5, probability)


def test_other_mistakes_are_named():
    with pytest.raises(ValueError, match=r"initial_gap=0.0 .* \(0, inf\)"):
        expectation_recipe(BANDIT, 0.5, initial_gap=0.0)
    with pytest.raises(ValueError, match="n_envs=0"):
        expectation_recipe(BANDIT, 0.5).total_timesteps(0)


def test_the_example_runs():
    assert doctest.testmod(theory) == (0, 4)
