import math

import pytest
import torch

from sb3_crpn.algorithm.evaluation import CandidateEvaluator, StepEvaluation
from tests.policies import ACTION_SPACES, frozen_episodes, log_probabilities, small_policy


def attempt_of(kind, dtype=torch.float64):
    policy, actor = small_policy(kind, dtype=dtype)
    batch = frozen_episodes(policy)
    generator = torch.Generator().manual_seed(0)
    step = 0.1 * torch.randn(len(actor), dtype=torch.float64, generator=generator)
    return policy, actor, batch, step


@pytest.mark.parametrize("kind", ACTION_SPACES)
def test_a_trial_measures_the_surrogate_cost_and_the_divergence(kind):
    policy, actor, batch, step = attempt_of(kind)
    before = log_probabilities(policy, batch).detach()
    tester = CandidateEvaluator(policy, actor, batch)
    trial = tester.evaluate(step)
    ratio = (log_probabilities(policy, batch).detach() - before).exp()
    change = (torch.from_numpy(batch.cost_advantages) * (ratio - 1.0)).sum() / batch.n_episodes
    assert trial.surrogate_change == pytest.approx(change.item())
    assert trial.finite

    tester.restore()
    observations = batch.observations.repeat(4000, 1)
    reference = policy.get_distribution(observations)
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(0)
        actions = reference.sample()
        old_log_prob = reference.log_prob(actions)
        actor.assign(actor.vector + step)
        samples = old_log_prob - policy.get_distribution(observations).log_prob(actions)
    n_components = 1 if actions.ndim == 1 else actions.shape[1]
    samples = samples / n_components
    error = samples.std() / len(samples) ** 0.5
    assert abs(trial.kl - samples.mean()) < 5.0 * error


@pytest.mark.parametrize("kind", ACTION_SPACES)
def test_a_trial_in_pieces_is_the_same(kind):
    policy, actor, batch, step = attempt_of(kind)
    whole = CandidateEvaluator(policy, actor, batch).evaluate(step)
    actor.assign(actor.vector - step)
    pieces = CandidateEvaluator(policy, actor, batch, max_steps=4).evaluate(step)
    assert pieces.kl == pytest.approx(whole.kl, rel=1e-12)
    assert pieces.surrogate_change == pytest.approx(whole.surrogate_change, rel=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_restore_is_bitwise(dtype):
    policy, actor, batch, step = attempt_of("gaussian", dtype)
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    tester = CandidateEvaluator(policy, actor, batch)
    tester.evaluate(step)
    assert not torch.equal(policy.action_net.weight, before["action_net.weight"])
    tester.evaluate(1e30 * step)
    tester.restore()
    for name, value in policy.state_dict().items():
        assert torch.equal(value, before[name])


def test_trials_start_from_the_origin():
    policy, actor, batch, step = attempt_of("discrete")
    tester = CandidateEvaluator(policy, actor, batch)
    origin = actor.vector
    first = tester.evaluate(step)
    tester.evaluate(-3.0 * step)
    assert tester.evaluate(step) == first
    assert torch.equal(actor.vector, origin + step)
    assert tester.evaluate(torch.zeros_like(step)).kl == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_steps_that_are_not_finite_are_not_taken(value):
    policy, actor, batch, step = attempt_of("discrete")
    tester = CandidateEvaluator(policy, actor, batch)
    origin = actor.vector
    step[0] = value
    assert tester.evaluate(step) == StepEvaluation(math.inf, math.inf)
    assert torch.equal(actor.vector, origin)


@pytest.mark.parametrize("kind", ACTION_SPACES)
def test_a_policy_that_overflows_is_not_usable(kind):
    policy, actor, batch, step = attempt_of(kind, torch.float32)
    tester = CandidateEvaluator(policy, actor, batch)
    assert not tester.evaluate(1e38 * step.sign()).finite
    tester.restore()
    assert tester.evaluate(0.1 * step).finite
