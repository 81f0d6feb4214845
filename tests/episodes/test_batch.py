from dataclasses import fields

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_crpn.episodes import EpisodeBatch, episode_scan
from sb3_crpn.episodes.batch import (
    concatenate,
    discount_factors,
    episode_starts,
    episode_time,
    round_robin_split,
)

LENGTHS = st.lists(st.integers(1, 7), min_size=1, max_size=6)
FACTORS = st.sampled_from([0.0, 0.5, 0.99, 1.0])
SEEDS = st.integers(0, 10_000)


def naive_scan(values, factor, lengths, reverse):
    result = np.array(values)
    for start, length in zip(episode_starts(lengths), lengths, strict=True):
        steps = range(start + 1, start + length)
        for i in reversed([k - 1 for k in steps]) if reverse else steps:
            result[i] += factor * result[i + 1 if reverse else i - 1]
    return result


@given(LENGTHS, FACTORS, SEEDS, st.booleans(), st.sampled_from([(), (1,), (3,)]))
@settings(deadline=None)
def test_scan_is_the_recursion_within_each_episode(lengths, factor, seed, reverse, trailing):
    lengths = np.array(lengths)
    values = np.random.default_rng(seed).normal(size=(lengths.sum(), *trailing))
    original = values.copy()
    result = episode_scan(values, factor, lengths, reverse=reverse)
    np.testing.assert_allclose(
        result, naive_scan(values, factor, lengths, reverse), rtol=1e-12, atol=1e-12
    )
    assert np.array_equal(values, original)


def test_scan_of_a_long_batch_keeps_its_precision():
    lengths = np.array([50_000, 1, 50_000])
    values = np.ones(lengths.sum())
    expected = episode_time(lengths) + 1.0
    assert np.array_equal(episode_scan(values, 1.0, lengths), expected)


def test_powers_that_underflow_are_zero_whatever_numpy_is_told():
    lengths = np.array([2000, 3])
    with np.errstate(all="raise"):
        factors = discount_factors(0.5, lengths)
        sums = episode_scan(np.ones(2003), 0.5, lengths)
    assert factors[[0, 3, 1999, 2000, 2002]].tolist() == [1.0, 0.125, 0.0, 1.0, 0.25]
    np.testing.assert_allclose(sums[[0, 1, 1999, 2000, 2002]], [1.0, 1.5, 2.0, 1.0, 1.75])


def test_time_and_starts_of_episodes_laid_end_to_end():
    lengths = np.array([2, 1, 3])
    assert episode_starts(lengths).tolist() == [0, 2, 3]
    assert episode_time(lengths).tolist() == [0, 1, 0, 0, 1, 2]


def numbered_batch(lengths, *, is_dict=False):
    """Every array holds the indices of its steps."""
    steps = np.arange(float(sum(lengths)))
    tensor, ends = torch.from_numpy(steps), torch.arange(float(len(lengths)))
    return EpisodeBatch(
        observations={"a": tensor, "b": -tensor[:, None]} if is_dict else tensor[:, None],
        actions=tensor.long(),
        lengths=np.array(lengths),
        cost_advantages=steps,
        values=steps + 0.5,
        returns=-steps,
        rewards=2 * steps,
        log_probs=3 * steps,
        next_observations={"a": ends, "b": -ends[:, None]} if is_dict else ends[:, None],
        bootstrapped=np.arange(len(lengths)) % 2 == 1,
        times=np.zeros(len(lengths), dtype=int),
        trajectories=np.arange(len(lengths)),
    )


@pytest.mark.parametrize("is_dict", [False, True])
def test_take_selects_whole_episodes_in_the_order_given(is_dict):
    batch = numbered_batch([2, 1, 3], is_dict=is_dict)
    taken = batch.take(np.array([2, 0]))
    steps = [3, 4, 5, 0, 1]
    assert taken.n_episodes == 2
    assert taken.n_steps == 5
    assert taken.lengths.tolist() == [3, 2]
    assert taken.actions.tolist() == steps
    assert taken.cost_advantages.tolist() == steps
    assert taken.values.tolist() == [i + 0.5 for i in steps]
    assert taken.returns.tolist() == [-i for i in steps]
    assert taken.bootstrapped.tolist() == [False, False]
    ends = taken.next_observations["a"] if is_dict else taken.next_observations.flatten()
    assert ends.tolist() == [2, 0]
    if is_dict:
        assert taken.observations["a"].tolist() == steps
        assert taken.observations["b"].tolist() == [[-i] for i in steps]
    else:
        assert taken.observations.tolist() == [[i] for i in steps]


@given(LENGTHS, st.integers(1, 8))
@settings(deadline=None)
def test_split_deals_every_episode_once(lengths, n_groups):
    batch = numbered_batch(lengths)
    groups = batch.split(n_groups)
    sizes = [group.n_episodes for group in groups]
    assert len(groups) == min(n_groups, len(lengths))
    assert max(sizes) - min(sizes) <= 1
    steps = np.concatenate([group.cost_advantages for group in groups])
    assert np.array_equal(np.sort(steps), batch.cost_advantages)
    for group in groups:
        starts = episode_starts(group.lengths)
        assert np.array_equal(
            group.cost_advantages,
            episode_time(group.lengths) + np.repeat(group.cost_advantages[starts], group.lengths),
        )
    assert batch.split(1) == [batch]


@given(st.integers(0, 20), st.integers(1, 8), st.integers(0, 20))
def test_every_episode_is_dealt_once(n_episodes, n_groups, first):
    groups = round_robin_split(np.arange(n_episodes), n_groups, first)
    sizes = [len(group) for group in groups]
    assert len(groups) == n_groups
    assert max(sizes) - min(sizes) <= 1
    assert np.array_equal(np.sort(np.concatenate(groups)), np.arange(n_episodes))
    if n_episodes:
        assert groups[first % n_groups][0] == 0


@given(st.lists(st.integers(0, 6), min_size=1, max_size=4), st.integers(1, 3))
def test_dealing_goes_on_where_another_rank_stopped(counts, n_groups):
    whole = round_robin_split(np.arange(sum(counts)), n_groups)
    starts = np.cumsum(counts) - counts
    parts = [
        round_robin_split(np.arange(n), n_groups, first=start)
        for n, start in zip(counts, starts, strict=True)
    ]
    for k, group in enumerate(whole):
        joined = [part[k] + start for part, start in zip(parts, starts, strict=True)]
        assert np.array_equal(np.concatenate(joined), group)


@given(LENGTHS, st.integers(1, 12))
@settings(deadline=None)
def test_pieces_are_runs_of_whole_episodes_within_the_limit(lengths, max_steps):
    batch = numbered_batch(lengths)
    pieces = batch.chunks(max_steps)
    assert np.array_equal(
        np.concatenate([piece.cost_advantages for piece in pieces]), batch.cost_advantages
    )
    assert np.array_equal(np.concatenate([piece.lengths for piece in pieces]), lengths)
    for piece, following in zip(pieces, [*pieces[1:], None], strict=True):
        assert piece.n_steps <= max_steps or piece.n_episodes == 1
        assert piece.actions.data_ptr() >= batch.actions.data_ptr()
        if following is not None:
            assert piece.n_steps + following.lengths[0] > max_steps
    assert batch.chunks(None) == [batch]


def test_nothing_has_no_pieces():
    nothing = numbered_batch([2, 1]).take(np.arange(0))
    assert nothing.n_episodes == nothing.n_steps == 0
    assert nothing.chunks(None) == nothing.chunks(3) == []
    assert episode_scan(nothing.cost_advantages, 0.5, nothing.lengths, reverse=True).shape == (0,)


@pytest.mark.parametrize("is_dict", [False, True])
def test_concatenate_puts_back_together_what_take_took_apart(is_dict):
    batch = numbered_batch([2, 1, 3, 4], is_dict=is_dict)
    parts = [batch.take(np.array(episodes)) for episodes in ([0, 1], [2], [3])]
    joined = concatenate(parts)
    for field in fields(EpisodeBatch):
        whole, again = getattr(batch, field.name), getattr(joined, field.name)
        for one, other in zip(
            whole.values() if isinstance(whole, dict) else [whole],
            again.values() if isinstance(again, dict) else [again],
            strict=True,
        ):
            np.testing.assert_array_equal(one, other)
    assert concatenate([batch]) is batch
