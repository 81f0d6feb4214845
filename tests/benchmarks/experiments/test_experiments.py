import numpy as np
import pandas as pd
import pytest
import torch

from benchmarks.exact import lipschitz_constants, random_mdp
from benchmarks.experiments import cartpole, escape, sample_complexity, variance
from benchmarks.experiments.learners import make_learner
from benchmarks.experiments.sample_complexity import PROBLEMS, exact_updates
from sb3_crpn.curvature import Causal
from tests.mdp import differs


def test_the_constants_are_those_of_the_problems():
    for problem in PROBLEMS.values():
        constants = lipschitz_constants(problem.mdp, n_starts=3)
        assert constants == pytest.approx((problem.L, problem.L_H), rel=3e-3)
    assert (escape.L, escape.L_H) == (PROBLEMS["plateau"].L, PROBLEMS["plateau"].L_H)


def test_steps_with_exact_derivatives_reach_stationary_points_at_the_predicted_rates():
    """The gap δ to an optimum at infinity falls by δ² a gradient step, δ^{3/2} a cubic one."""
    for algorithm, power in (("REINFORCE", 1.0), ("CRPN, paper", 0.5)):
        counts = exact_updates(PROBLEMS["plateau"], algorithm)
        ratio = counts[-1] / counts[-2]  # ε = 0.002 and 0.001
        assert ratio == pytest.approx(2**power, rel=0.03)


def test_an_escape_is_measured():
    (row,) = escape.measure("CRPN, paper", 3 * escape.L_H, 64, "saddle", 0)
    assert row == {"episodes": 64 * row["updates"], "escaped": 1, "updates": row["updates"]}
    assert 1 <= row["updates"] <= 5


def test_batches_are_those_of_the_recipe():
    (row,) = sample_complexity.measure("plateau", "REINFORCE", 0.4, 0)
    assert row["episodes"] == 50 * row["updates"] > 0


@pytest.mark.parametrize("algorithm", ["CRPN", "ACRPN"])
def test_updates_of_cartpole_are_recorded_with_what_they_learnt_from(algorithm):
    rows = cartpole.measure(algorithm, "", seed=0, n_updates=3)
    assert [row["update"] for row in rows] == [1, 2, 3]
    sums = [50 * row["mean_return"] for row in rows]  # of fifty lengths
    assert sums == pytest.approx(np.round(sums))
    assert 15 < rows[0]["mean_return"] < 35  # the uniform policy's is 22
    assert all(row["kl_divergence"] > 0 for row in rows)


def test_cartpole_is_solved_by_a_hundred_episodes_in_a_row():
    returns = {0: [100.0, 500.0, 450.0, 450.0], 1: [480.0, 460.0, 490.0, 460.0]}
    rows = pd.DataFrame(
        [
            {"algorithm": "CRPN", "change": "", "seed": seed, "update": k + 1, "mean_return": value}
            | {"gradient_noise": 0.1, "negative_share": 0.2, "kl_divergence": 0.01}
            for seed, values in returns.items()
            for k, value in enumerate(values)
        ]
    )
    last = cartpole.table(rows).splitlines()[-1].split("|")
    assert [cell.strip() for cell in last[3:5]] == ["2 of 2", "3, 3"]
    rows.loc[rows.seed == 0, "mean_return"] -= 5.0
    assert "| 1 of 2 | 3 |" in cartpole.table(rows)


@pytest.mark.parametrize("kind", ["fitted", "exact"])
def test_baselines_take_away_variance_and_no_truth(kind):
    mdp = random_mdp(0, horizon=3)
    theta = torch.ones(mdp.n_parameters, dtype=torch.float64)
    model = make_learner("CRPN, paper", mdp, 2000, theta, seed=0)
    fit, *batches = model.estimate_curvature(2100).gradient_batch.split(21)
    values = mdp.values(theta).numpy()
    if kind == "fitted":
        values = np.tile(variance._mean_returns(mdp, fit), (3, 1))
    weights = Causal(1.0)
    hessians = torch.stack(
        [
            variance._hessian(model, variance._less_baseline(mdp, batch, values), weights)
            for batch in batches
        ]
    )
    assert not differs(hessians, mdp.hessian(theta))
    assert differs(hessians, mdp.hessian(theta) + 1.0)
    costs = np.concatenate([batch.cost_advantages for batch in batches])
    advantages = [variance._less_baseline(mdp, batch, values).cost_advantages for batch in batches]
    assert np.std(np.concatenate(advantages)) < np.std(costs)
