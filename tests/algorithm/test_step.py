from dataclasses import replace

import pytest
import torch

from sb3_crpn.algorithm.evaluation import CandidateEvaluator
from sb3_crpn.algorithm.solvers import DenseSolver
from sb3_crpn.algorithm.step import take_step
from sb3_crpn.curvature import Causal, Constant, Fisher, estimate_curvature, subspace_model
from tests.policies import frozen_episodes, small_policy

TARGET = 0.01


class Recorded:
    """A solver that records every α."""

    def __init__(self):
        self.alphas = []

    def needs_matrix(self, dim):
        return True

    def solve(self, model, alpha):
        self.alphas.append(alpha)
        return DenseSolver().solve(model, alpha)


@pytest.fixture
def attempt():
    policy, actor = small_policy("gaussian")
    batch = frozen_episodes(policy, (5,) * 8)
    estimate = estimate_curvature(policy, actor, batch, Causal(0.9))
    model = subspace_model(estimate, Fisher(0.1), Constant(0.5))
    return actor, CandidateEvaluator(policy, actor, batch), model


@pytest.mark.parametrize("alpha", [1e-3, 1.0, 1e4])
def test_no_step_is_tried_twice_and_the_actor_is_at_the_best(attempt, alpha):
    actor, evaluator, model = attempt
    origin, solver = actor.vector, Recorded()
    step, accepted = take_step(evaluator, model, solver, alpha, TARGET)
    assert accepted
    assert len(set(solver.alphas)) == len(solver.alphas) == evaluator.n_trials
    assert step.alpha in solver.alphas
    assert 0.9 * TARGET <= step.kl <= TARGET
    assert torch.equal(actor.vector, origin + step.step)
    assert evaluator.evaluate(step.step) == step.evaluation


def test_an_earlier_trial_may_be_the_best(attempt, monkeypatch):
    """A smaller α does not lengthen this step. The previous trial is accepted."""
    actor, evaluator, model = attempt
    origin, evaluate = actor.vector, evaluator.evaluate
    short = []

    def reported(step):
        evaluation = evaluate(step)
        short.append(step)
        return type(evaluation)(0.5 * TARGET, -1.0)

    monkeypatch.setattr(evaluator, "evaluate", reported)
    step, accepted = take_step(evaluator, model, DenseSolver(), 1.0, TARGET)
    assert accepted
    assert len(short) == 2
    assert step.alpha == 1.0
    assert torch.equal(actor.vector, origin + short[0])


def test_alpha_that_is_given_is_tried_once(attempt):
    _, evaluator, model = attempt
    solver = Recorded()
    step, accepted = take_step(evaluator, model, solver, 7.0, None)
    assert accepted
    assert solver.alphas == [7.0] == [step.alpha]
    assert evaluator.n_trials == 1


def test_a_step_that_raises_the_surrogate_is_taken_back(attempt, monkeypatch):
    actor, evaluator, model = attempt
    origin, evaluate = actor.snapshot(), evaluator.evaluate

    def uphill(step):
        return replace(evaluate(step), surrogate_change=1e-12)

    monkeypatch.setattr(evaluator, "evaluate", uphill)
    step, accepted = take_step(evaluator, model, DenseSolver(), 1.0, TARGET)
    assert not accepted
    assert step.kl > 0.0
    assert all(torch.equal(a, b) for a, b in zip(actor.tensors, origin, strict=True))
