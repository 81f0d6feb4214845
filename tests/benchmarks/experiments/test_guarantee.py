import numpy as np
import pytest
import torch

from benchmarks.exact import coordination_mdp
from benchmarks.experiments import guarantee
from benchmarks.experiments.guarantee import PROBLEMS, RECIPES, _batch_means
from sb3_crpn.theory import Constants, softmax_linear
from tests.mdp import differs

THETA = np.random.default_rng(0).normal(size=6)


def test_enumerated_estimates_have_the_exact_mean():
    p, g, H = PROBLEMS["coordination"].estimates(THETA)
    mdp, theta = coordination_mdp(), torch.from_numpy(THETA)
    assert p.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(p @ g, mdp.gradient(theta), atol=1e-14)
    np.testing.assert_allclose(np.einsum("t,tij->ij", p, H), mdp.hessian(theta), atol=1e-14)


@pytest.mark.parametrize(("m", "b"), [(3, 8), (8, 3), (5, 5)])
def test_batches_are_means_of_that_many_episodes(m, b):
    rng, (p, g, H) = np.random.default_rng(0), PROBLEMS["coordination"].estimates(THETA)
    batches = [_batch_means(rng, p, g, H, m, b) for _ in range(2000)]
    gradients = np.stack([batch[0] for batch in batches])
    assert not differs(gradients, p @ g)
    assert not differs([batch[1].numpy() for batch in batches], np.einsum("t,tij->ij", p, H))
    variance = p @ g**2 - (p @ g) ** 2
    np.testing.assert_allclose(gradients.var(0), variance / m, rtol=0.2, atol=1e-12)


@pytest.mark.parametrize("problem", PROBLEMS)
def test_the_initial_gap_is_one_and_the_constants_hold(problem):
    chosen = PROBLEMS[problem]
    p, g, H = chosen.estimates(np.zeros(chosen.d))
    constants = Constants(1.0, softmax_linear(1.0), chosen.horizon, chosen.d)
    assert p @ chosen.rewards.sum(1) == pytest.approx(0.0)
    assert chosen.rewards.sum(1).max() == 1.0
    assert np.linalg.norm(g, axis=1).max() <= constants.G_g
    assert np.linalg.norm(H, 2, axis=(1, 2)).max() <= constants.G_H


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_run_leaves_the_start_and_stays_inside(recipe):
    (row,) = guarantee.measure("bandit", recipe, 0, n_updates=40)
    assert row["gradient_bound"] == pytest.approx(0.5)
    assert 0 < row["first_inside"] < 20
    assert row["gradient_R"] < 1.0  # at θ_0
    assert row["share_inside"] > 0.5
    assert "| bandit |" in guarantee.table(
        guarantee.pd.DataFrame([{"problem": "bandit", "recipe": recipe, "seed": 0} | row])
    )
