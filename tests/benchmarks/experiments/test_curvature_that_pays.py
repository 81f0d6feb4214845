"""The instruments for steps and Hessians, on decision processes whose derivatives are known."""

import itertools

import numpy as np
import pandas as pd
import pytest
import torch

from benchmarks.exact import (
    TabularEnv,
)
from benchmarks.experiments import auto_kl, heldout, oracle
from benchmarks.experiments.auto_kl import AutoKL
from benchmarks.experiments.confirmed import (
    ConfirmedCRPN,
    recommendations,
    secant_curvature,
)
from benchmarks.experiments.crossfit import CrossFit, confirm_natural_step
from benchmarks.experiments.hessians import (
    ConfirmedHessian,
    FreshHessian,
    MemoryHessian,
    OracleHessian,
)
from benchmarks.experiments.steps import Subspace, fisher_subspace, parabola_kl, step_of_kl
from benchmarks.learning.store import RESULTS, read_curves
from sb3_crpn.algorithm.update import UpdateData
from sb3_crpn.curvature import Causal
from sb3_crpn.curvature.derivatives import EpisodeDerivatives
from sb3_crpn.episodes import concatenate
from tests.benchmarks.experiments.learner import (
    KAPPA,
    MDP,
    THETA,
    exact_derivatives,
    exact_model,
    make_learner,
)


@pytest.mark.parametrize("kl", [0.001, 0.1])
def test_a_step_minimises_the_cubic_model_at_its_divergence(kl):
    generator = torch.Generator().manual_seed(0)
    gradient = torch.randn(5, generator=generator, dtype=torch.float64)
    hessian = torch.randn(5, 5, generator=generator, dtype=torch.float64)
    hessian = hessian + hessian.T
    space = Subspace(torch.eye(5, dtype=torch.float64), torch.linspace(0.3, 1.0, 5).double())
    step = step_of_kl(gradient, hessian, space, kl)
    assert 0.5 * float(step @ (space.fisher * step)) == pytest.approx(kl, rel=1e-4)

    def model(y):
        return (gradient * y).sum(-1) + 0.5 * torch.einsum("...i,ij,...j->...", y, hessian, y)

    others = torch.randn(2000, 5, generator=generator, dtype=torch.float64)
    others *= step.norm() / others.norm(dim=1, keepdim=True)
    assert model(step) <= model(others).min()


def test_a_newton_step_within_the_divergence_is_taken():
    gradient = torch.tensor([1.0, -2.0], dtype=torch.float64)
    hessian = torch.diag(torch.tensor([100.0, 50.0], dtype=torch.float64))
    space = Subspace(torch.eye(2, dtype=torch.float64), torch.ones(2, dtype=torch.float64))
    step = step_of_kl(gradient, hessian, space, kl=0.1)
    assert step.tolist() == pytest.approx([-0.01, 0.04], rel=1e-4)


def test_the_subspace_whitens_the_damped_fisher_matrix():
    model = make_learner()
    batch = model.estimate_curvature(4).gradient_batch
    group = EpisodeDerivatives(model.policy, model.actor, batch, Causal(KAPPA))
    dense = torch.stack([group.fisher_product(e) for e in torch.eye(len(THETA)).double()])
    space = fisher_subspace([group], group.gradient(), 0.1, dim=3)
    identity = space.basis.T @ (dense @ space.basis + 0.1 * space.basis)
    assert torch.allclose(identity, torch.eye(3).double(), atol=1e-6)
    y = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    step = space.basis @ y
    assert space.length(y) == pytest.approx(float(step @ dense @ step) ** 0.5, rel=1e-5)


def test_with_many_episodes_the_judges_know_the_exact_derivatives():
    space, g, H = exact_model()
    model = make_learner(n_envs=100)
    rows = pd.DataFrame(heldout.judge_steps(model, 800, np.random.default_rng(0)))
    for kl, name in itertools.product(heldout.KLS, ("none", "others", "all")):
        y = step_of_kl(g, torch.zeros_like(H) if name == "none" else H, space, kl)
        slope, curvature = -float(g @ y), float(y @ H @ y)
        means = rows[(rows.hessian == name) & (rows.kl == kl)].mean(numeric_only=True)
        length = (2 * kl) ** 0.5
        assert means.length == pytest.approx(length, rel=1e-4)
        assert means.test_slope == pytest.approx(slope / length, rel=0.05)
        assert means.test_curvature == pytest.approx(curvature / length**2, abs=0.1)
        assert means.test_gain == pytest.approx(slope - 0.5 * curvature, rel=0.05)


def test_held_out_episodes_judge_without_bias_and_the_own_ones_do_not():
    model = make_learner()
    gradient, hessian, _ = exact_derivatives()
    errors = []
    for _ in range(60):
        batch = model.estimate_curvature(8).gradient_batch
        earlier = model.estimate_curvature(4).gradient_batch
        folds = CrossFit(model, batch, [earlier])
        for fold in folds:
            y = -fold.gradient / fold.space.length(fold.gradient)
            step = fold.space.basis @ y
            exact = -float(gradient @ step)
            errors.append(
                [
                    -float(fold.gradient @ y) - exact,
                    -float(fold.test_gradient @ y) - exact,
                    folds.test_curvature(fold, y) - float(step @ hessian @ step),
                ]
            )
    means = np.reshape(errors, (60, -1, 3)).mean(1)  # the folds of a rollout share episodes
    scores = means.mean(0) / (means.std(0, ddof=1) / np.sqrt(len(means)))
    assert scores[0] > 3.0
    assert abs(scores[1]) < 3.0
    assert abs(scores[2]) < 3.0


def test_a_confirmation_is_the_mean_over_folds():
    model = make_learner()
    folds = CrossFit(model, model.estimate_curvature(9).gradient_batch, [])
    confirmed = confirm_natural_step(folds)
    assert sum(fold.weight for fold in folds) == pytest.approx(1.0)
    slopes = [
        fold.weight * float(fold.test_gradient @ fold.gradient) / fold.space.length(fold.gradient)
        for fold in folds
    ]
    assert confirmed.slope == pytest.approx(sum(slopes))
    assert confirmed.claimed_slope > confirmed.slope


def test_training_records_what_is_confirmed_and_what_the_next_rollout_says():
    model = make_learner(ConfirmedCRPN, n_reused_rollouts=2).learn(MDP.horizon * 8 * 4)
    rows = pd.DataFrame(model.records)
    assert len(rows) == 4
    assert rows.next_slope.isna().tolist() == [False, False, False, True]
    assert (rows.claimed_slope > 0).all()
    assert rows.length.max() <= (2 * 0.02) ** 0.5
    plain = make_learner(n_reused_rollouts=2).learn(MDP.horizon * 8 * 4)
    assert torch.equal(model.actor.vector, plain.actor.vector)  # nothing is disturbed


def test_a_parabola_is_recognised_by_its_secants_and_so_is_where_it_is_least():
    assert parabola_kl(0.2, 0.5) == pytest.approx(0.08)
    assert parabola_kl(-0.2, 0.5) == 0.0
    assert parabola_kl(0.2, -0.5) == np.inf
    lengths = np.array([0.1, 0.2, 0.3])
    rows = pd.DataFrame({"length": lengths, "slope": 0.2, "next_slope": 0.2 - 0.5 * lengths})
    rows = rows.assign(curvature=0.5)
    rejected = pd.DataFrame({"slope": [0.2], "length": [np.nan], "next_slope": [np.nan]})
    assert secant_curvature(pd.concat([rows, rejected])) == pytest.approx(0.5)
    for kls in recommendations(rows).values():
        assert kls.tolist() == pytest.approx([0.08] * 3)


def test_the_oracle_knows_the_hessian_better():
    _, exact, _ = exact_derivatives()
    errors = {}
    for factor in (1, 16):
        model = make_learner(OracleHessian)
        model.factor, model.env_id = factor, lambda: TabularEnv(MDP)
        deviations = []
        for _ in range(8):
            batch = model.estimate_curvature(16).gradient_batch
            before = model.num_timesteps
            estimate = model._estimate(UpdateData(batch, []))
            assert model.num_timesteps == before
            dense = estimate.hessian @ torch.eye(len(THETA)).double() / MDP.horizon
            deviations.append(float((dense - exact).norm()) ** 2)
        errors[factor] = np.mean(deviations)
    assert errors[1] / errors[16] == pytest.approx(16.0, rel=0.5)


def test_the_fresh_hessian_forgets_earlier_rollouts_and_the_gradient_does_not():
    model = make_learner(FreshHessian)
    batch, earlier = (model.estimate_curvature(6).gradient_batch for _ in range(2))
    estimate = model._estimate(UpdateData(batch, [earlier]))
    direction = torch.ones(len(THETA), dtype=torch.float64)
    alone = model._estimate(UpdateData(batch, []))
    assert torch.allclose(estimate.hessian @ direction, alone.hessian @ direction)
    assert not torch.allclose(estimate.gradient, alone.gradient)


def test_the_memory_has_rollouts_that_the_gradient_has_not():
    model = make_learner(MemoryHessian, n_reused_rollouts=1)
    model.learn(MDP.horizon * 8 * 4)
    _, _, third, last = model._memory._batches
    remembered = model._memory.reweighted(model.policy, **model._weighting)
    joined = model._estimate_from(concatenate([last, *remembered]))
    estimate = model._estimate(UpdateData(last, [third]))
    direction = torch.ones(len(THETA), dtype=torch.float64)
    assert torch.allclose(estimate.hessian @ direction, joined.hessian @ direction)
    assert estimate.gradient_batch.n_episodes == last.n_episodes + third.n_episodes
    model.learn(MDP.horizon * 8)
    assert len(model._memory._batches) == 1


def test_a_choice_of_the_hessian_has_the_value_of_its_step():
    space, g, H = exact_model()
    model = make_learner(ConfirmedHessian, n_envs=100, target_kl=0.1)
    batch, earlier = (model.estimate_curvature(4000).gradient_batch for _ in range(2))
    model._estimate(UpdateData(batch, [earlier]))
    assert len(model.values) == 10
    for (_, omega), value in model.values.items():
        y = step_of_kl(g, omega * H, space, 0.1)
        assert value == pytest.approx(-float(g @ y + 0.5 * y @ H @ y), rel=0.05)
    assert model.values[model.choice] == max(model.values.values())
    assert model.hessian_shrinkage == model.choice[1]


def test_what_one_episode_says_of_the_hessian_is_not_believed():
    model = make_learner(ConfirmedHessian)
    batch = model.estimate_curvature(1).gradient_batch
    model._estimate(UpdateData(batch, []))
    assert model.choice == ("all", 0.0)


def test_runs_of_the_oracle_study_differ_in_the_hessian_alone(monkeypatch):
    monkeypatch.setattr(oracle, "TASKS", {"CartPole-v1": oracle.Task(1200)})
    returns = {
        hessian: oracle.measure("CartPole-v1", 0.02, hessian, 0)[0]["mean_return"]
        for hessian in ("none", "4", "memory", "confirmed")
    }
    assert all(10 < value < 100 for value in returns.values())
    assert len(set(returns.values())) > 1


def test_targets_follow_what_is_confirmed():
    model = make_learner(AutoKL)
    model.fraction = 0.5
    model.learn(MDP.horizon * 8 * 6)
    records = pd.DataFrame(model.records)
    targets = [0.02]
    for k in range(1, len(records)):
        past = records[:k]
        faded = 0.9 ** np.arange(k - 1, -1, -1)  # of the secants, the last one new
        curvature = (faded * past.length * (past.slope - past.next_slope)).sum() / (
            faded * past.length**2
        ).sum()
        slope = np.average(records.slope[: k + 1], weights=0.9 ** np.arange(k, -1, -1))
        targets.append(min(0.1, max(0.002, 0.5 * parabola_kl(slope, curvature))))
    assert records.target_kl.tolist() == pytest.approx(targets)


def test_the_entrys_runs_are_cut_at_the_budget():
    (row,) = auto_kl.entry_rows("CartPole-v1", [0])
    curves = read_curves(RESULTS)
    curve = curves[(curves.algo == "CRPN") & (curves.env == "CartPole-v1") & (curves.seed == 0)]
    assert row["mean_return"] == pytest.approx(
        curve["return"][curve.steps <= auto_kl.BUDGET].mean()
    )
    assert row["median_target_kl"] == 0.01
