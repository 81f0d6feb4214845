import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_crpn.episodes.advantages import cost_advantages, generalized_advantages
from sb3_crpn.episodes.batch import episode_starts

LENGTHS = st.lists(st.integers(1, 7), min_size=1, max_size=6)
FACTORS = st.sampled_from([0.0, 0.5, 0.99, 1.0])
SEEDS = st.integers(0, 10_000)


def random_episodes(lengths, seed):
    """Lengths, rewards, values, terminal values and traces."""
    lengths, rng = np.array(lengths), np.random.default_rng(seed)
    rewards, values = rng.normal(size=(2, lengths.sum()))
    return lengths, rewards, values, rng.normal(size=len(lengths)), rng.uniform(size=lengths.sum())


@given(LENGTHS, FACTORS, FACTORS, SEEDS)
@settings(deadline=None)
def test_advantages_are_the_discounted_sums_of_residuals(lengths, gamma, gae_lambda, seed):
    lengths, rewards, values, terminal_values, _ = random_episodes(lengths, seed)
    expected = []
    for e, start in enumerate(episode_starts(lengths)):
        length = lengths[e]
        V = np.append(values[start : start + length], terminal_values[e])
        delta = rewards[start : start + length] + gamma * V[1:] - V[:-1]
        for i in range(length):
            decay = (gamma * gae_lambda) ** np.arange(length - i)
            expected.append(decay @ delta[i:])
    advantages = generalized_advantages(
        rewards, values, terminal_values, lengths, gamma, gae_lambda
    )
    np.testing.assert_allclose(advantages, expected, rtol=1e-12, atol=1e-12)


@given(LENGTHS, FACTORS, FACTORS, SEEDS)
@settings(deadline=None)
def test_traces_discount_what_lies_behind_a_step(lengths, gamma, gae_lambda, seed):
    lengths, rewards, values, terminal_values, traces = random_episodes(lengths, seed)
    expected = np.empty(lengths.sum())
    for e, start in enumerate(episode_starts(lengths)):
        V, following = terminal_values[e], 0.0
        for i in reversed(range(start, start + lengths[e])):
            delta = rewards[i] + gamma * V - values[i]
            expected[i] = delta + gamma * gae_lambda * following
            V, following = values[i], traces[i] * expected[i]
    arguments = (rewards, values, terminal_values, lengths, gamma, gae_lambda)
    np.testing.assert_allclose(
        generalized_advantages(*arguments, traces), expected, rtol=1e-12, atol=1e-12
    )
    np.testing.assert_allclose(
        generalized_advantages(*arguments, np.ones(lengths.sum())),
        generalized_advantages(*arguments),
        rtol=1e-12,
        atol=1e-12,
    )


def test_no_steps_have_no_advantages():
    none = np.zeros(0)
    assert generalized_advantages(none, none, none, np.zeros(0, int), 0.9, 0.9, none).size == 0


def test_weights_are_costs_normalised_and_discounted_on_request():
    lengths = np.array([2, 3])
    advantages = np.array([1.0, -2.0, 0.5, 4.0, -1.0])
    options = {"gamma": 0.5, "normalize_advantage": False, "discount_visitation": False}
    original, times = advantages.copy(), np.zeros(2, int)
    np.testing.assert_array_equal(
        cost_advantages(advantages, lengths, times, **options), -advantages
    )
    discounted = cost_advantages(
        advantages, lengths, times, **options | {"discount_visitation": True}
    )
    np.testing.assert_array_equal(discounted, -advantages * [1, 0.5, 1, 0.5, 0.25])
    later = cost_advantages(
        advantages, lengths, np.array([1, 0]), **options | {"discount_visitation": True}
    )
    np.testing.assert_array_equal(later, -advantages * [0.5, 0.25, 1, 0.5, 0.25])
    normalised = cost_advantages(
        advantages, lengths, times, **options | {"normalize_advantage": True}
    )
    assert normalised.mean() == pytest.approx(0.0, abs=1e-12)
    assert normalised.std() == pytest.approx(1.0)
    assert np.corrcoef(normalised, advantages)[0, 1] == pytest.approx(-1.0)
    np.testing.assert_array_equal(advantages, original)
