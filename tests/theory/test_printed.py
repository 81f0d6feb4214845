"""The paper's printed formulas against numbers computed by hand from its text."""

import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_crpn import ACRPN, CRPN, PAPER
from sb3_crpn.theory import (
    Constants,
    PrintedConstants,
    ScoreBounds,
    approximate_recipe,
    expectation_recipe,
    high_probability_recipe,
    printed_approximate_complexity,
    printed_approximate_recipe,
    printed_expectation_recipe,
    printed_high_probability_recipe,
    softmax_linear,
)

# Proposition 1 and Lemmas 1, 2 by hand for K = 2, G = 3, L_1 = 5, L_2 = 7, H = 4
PROBLEM = Constants(2.0, ScoreBounds(3.0, 5.0, 7.0), H=4, d=6, gamma=0.9)
BY_HAND = {
    "initial_gap": 16,  # 2·2·4
    "M_H": 384,  # 2·3·64
    "G_H": 1312,  # 64·9·2 + 5·2·16
    "L_H": 19808,  # 256·27·2 + 3·64·3·5·2 + 7·2·16
    "G_g": 96,  # 3·2·16
    "M_1": 480,  # 3·2·16·5
    "M_2": 2624,  # 2·1312
    "least_hessian_episodes": 24,  # 4(1 + 2·2.4849) = 23.88
}
# All constants 1, d = 4: G_g = 1, M_1 = 2, G_H = 2, M_2 = 4, L_H = 1 + 3 + 1, 1 + 2 log 2d = 5.16
UNIT = Constants(1.0, ScoreBounds(1.0, 1.0, 1.0), H=1, d=4)
# Corresponding constants. The text's M_H bounds the gradient
PAIRS = {"M_H": "M_g", "G_H": "M_H", "L_H": "L_H", "G_g": "G_g", "M_1": "M_1", "M_2": "M_2"}


@pytest.mark.parametrize("name", BY_HAND)
def test_constants(name):
    assert getattr(PrintedConstants(PROBLEM), name) == BY_HAND[name]


def test_the_discount_is_not_in_the_printed_constants():
    undiscounted = PrintedConstants(replace(PROBLEM, gamma=1.0))
    assert all(getattr(undiscounted, name) == BY_HAND[name] for name in BY_HAND)


def test_errors_of_means():
    printed = PrintedConstants(PROBLEM)
    assert printed.gradient_error(9) == 32.0  # 96/√9
    # 4 √(15·5.969813) · 6 · 1312³ = 5.12909e11, and 36^{3/2} = 216
    assert printed.hessian_error(36) ** 3 == pytest.approx(5.12909e11 / 216, rel=1e-5)
    with pytest.raises(ValueError, match=r"n_episodes=23 .* an integer >= 24"):
        printed.hessian_error(23)


def test_expectation_recipe():
    recipe = printed_expectation_recipe(UNIT, 0.25)
    assert recipe.n_updates == 430  # 12 √5 · 2/0.125 = 429.3
    assert recipe.kwargs == {
        "alpha": 15.0,
        "n_episodes": 100,  # 25/(4·0.0625)
        "n_hessian_episodes": 7793,  # 36 · 154.766^⅓ · 4^⅔ · 4/0.25 = 7792.5
        "gamma": 1.0,
        "horizon": 1,
    }
    assert recipe.gradient_bound == 6.25
    assert recipe.curvature_bound == pytest.approx(7.8262379)  # 7 √1.25
    assert recipe.gradient_episodes == 43_000
    assert recipe.hessian_episodes == 430 * 7793


def test_remark_1_is_the_default_number_of_updates():
    for K in (0.5, 1.0):
        problem = replace(PROBLEM, K=K)
        root = math.sqrt(PrintedConstants(problem).L_H)
        expected = 24 * K * 4 * root / 0.3**1.5  # 24 K H √L_H ε^{-3/2}
        assert printed_expectation_recipe(problem, 0.3).n_updates == math.ceil(expected)


def test_high_probability_recipe():
    recipe = printed_high_probability_recipe(UNIT, 0.25, 0.43)  # δ' = 0.43/860 = 0.0005
    assert recipe.n_updates == 430
    logarithm = 9.680344  # log(8/0.0005)
    # M_1/t = 2/0.1, M_2/√t_1 = 4/(0.5/12)
    assert recipe.kwargs["n_episodes"] == math.ceil(400 * 8 / 3 * logarithm)
    assert recipe.kwargs["n_hessian_episodes"] == pytest.approx(9216 * 8 / 3 * logarithm, abs=1)
    assert recipe.kwargs["alpha"] == 15.0
    coarse = printed_high_probability_recipe(UNIT, 10.0, 0.5)  # t = 4 > M_1: the linear term
    logarithm = math.log(8 * 2 * coarse.n_updates / 0.5)
    assert coarse.kwargs["n_episodes"] == math.ceil(0.5 * 8 / 3 * logarithm)


def test_approximate_recipe():
    recipe = printed_approximate_recipe(UNIT, 0.25, 0.5)
    logarithm = 10.26192  # log(4 · 2.236068/(0.125 · 0.5) · 200)
    gradient = recipe.kwargs.pop("n_episodes")
    hessian = recipe.kwargs.pop("n_hessian_episodes")
    assert gradient == pytest.approx(1600**2 * logarithm, rel=1e-6)  # (2 · 200/0.25)²
    assert hessian == pytest.approx(512_000 * logarithm, rel=1e-6)  # (4 · 200)²/1.25
    assert recipe.kwargs == {
        "alpha": 5.0,
        "sosp_epsilon": 0.25,
        "gradient_lipschitz": 2.0,
        "subsolver_steps": 2,
        "stop_at_sosp": True,
        "gamma": 1.0,
        "horizon": 1,
    }
    coarse = printed_approximate_recipe(UNIT, 400.0, 0.5)  # M_1/(c_1 ε) > M_1²/(c_3² ε²)
    logarithm = math.log(4 * math.sqrt(5) / (8000 * 0.5) * 200)
    assert coarse.kwargs["n_episodes"] == math.ceil(2 * 300 / 400 * logarithm)
    assert (recipe.gradient_bound, recipe.rho) == (0.25, 5.0)


def test_sample_complexities_have_the_orders_of_the_remarks():
    """Remark 2: -7/2 and -5/2; Remark 3: -7/2 and, with N̂ products an update, -3."""
    fine, finer = 1e-4, 1e-6
    recipes = [printed_expectation_recipe(UNIT, epsilon) for epsilon in (fine, finer)]
    for name, order in (("gradient_episodes", 7), ("hessian_episodes", 5)):
        ratio = getattr(recipes[1], name) / getattr(recipes[0], name)
        assert ratio == pytest.approx(10.0**order, rel=1e-3)
    first, second = (printed_approximate_complexity(UNIT, epsilon) for epsilon in (fine, finer))
    assert second[0] / first[0] == pytest.approx(10.0**7)
    assert second[1] / first[1] == pytest.approx(10.0**6)
    # χ = 2: 2√5/0.125 = 35.777; (2/0.25)² = 64; (4/√1.25)²/√0.25 = 25.6
    expected = (64 * 35.77709, 25.6 * 35.77709)
    assert printed_approximate_complexity(UNIT, 0.25) == pytest.approx(expected)


positive = st.floats(0.01, 100.0)
problems = st.builds(
    Constants,
    positive,
    st.builds(ScoreBounds, positive, positive, positive),
    H=st.integers(1, 40),
    d=st.integers(1, 1000),
    gamma=st.floats(0.0, 1.0),
)


@settings(deadline=None)
@given(problems)
def test_derived_constants_are_no_larger_than_printed_ones(problem):
    printed, rounding = PrintedConstants(problem), 1 + 1e-12
    for theirs, ours in PAIRS.items():
        assert getattr(problem, ours) <= getattr(printed, theirs) * rounding
    assert 2 * problem.cost_bound <= printed.initial_gap * rounding
    assert problem.gradient_error(5) <= printed.gradient_error(5) * rounding


@settings(deadline=None)
@given(problems, st.floats(1e-3, 1.0))
def test_derived_recipes_need_no_more_updates_and_gradients_for_the_same_bound(problem, part):
    epsilon = part * problem.M_H**2 / problem.L_H
    pairs = [
        (expectation_recipe(problem, epsilon), printed_expectation_recipe(problem, epsilon / 25)),
        (
            high_probability_recipe(problem, epsilon, 0.05),
            printed_high_probability_recipe(problem, epsilon / 25, 0.05),
        ),
    ]
    for ours, theirs in pairs:
        assert theirs.gradient_bound == pytest.approx(ours.gradient_bound)
        assert ours.n_updates <= theirs.n_updates
        assert ours.kwargs["n_episodes"] <= theirs.kwargs["n_episodes"]


def test_where_derived_numbers_are_larger():
    """The third moment at H = 1, and b of the approximate recipe, whose printed ρ is larger."""
    bandit = Constants(1.0, softmax_linear(1.0), 1, 4)
    ratio = bandit.hessian_error(100) / PrintedConstants(bandit).hessian_error(100)
    assert ratio == pytest.approx(1.03, abs=0.005)
    longer = Constants(1.0, softmax_linear(1.0), 10, 10)
    epsilon = 0.1 * longer.M_H**2 / longer.L_H
    ours, theirs = (
        recipe(longer, epsilon, 0.05) for recipe in (approximate_recipe, printed_approximate_recipe)
    )
    b = "n_hessian_episodes"
    assert ours.kwargs[b] / theirs.kwargs[b] == pytest.approx(5.3, abs=0.1)
    assert theirs.curvature_bound / ours.curvature_bound == pytest.approx(21.6**0.5, rel=1e-2)


def test_algorithms_take_the_printed_recipes():
    settings = {"policy": "MlpPolicy", "env": "CartPole-v1", "device": "cpu"}
    recipe = printed_expectation_recipe(UNIT, 0.25)
    assert CRPN(**settings, **{**PAPER, **recipe.kwargs}).alpha == 15.0
    recipe = printed_approximate_recipe(UNIT, 0.25, 0.5)
    assert ACRPN(**settings, **{**PAPER, **recipe.kwargs}).subsolver_steps == 2


@pytest.mark.parametrize(
    ("recipe", "arguments", "message"),
    [
        (printed_expectation_recipe, (0.0,), r"epsilon=0.0 .* \(0, inf\)"),
        (printed_expectation_recipe, (0.1, -1.0), "initial_gap=-1.0"),
        (printed_high_probability_recipe, (0.1, 1.0), r"failure_probability=1.0 .* in \(0, 1\)"),
        (printed_approximate_recipe, (0.1, 0.0), "failure_probability=0.0"),
        (printed_approximate_complexity, (-1.0,), "epsilon=-1.0"),
        (printed_approximate_complexity, (1.0, 0.0), "initial_gap=0.0"),
    ],
)
def test_mistakes_are_named(recipe, arguments, message):
    with pytest.raises(ValueError, match=message):
        recipe(UNIT, *arguments)
