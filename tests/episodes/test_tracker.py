import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_crpn.algorithm import rollouts
from sb3_crpn.episodes import (
    EpisodeTracker,
    ProgressTracker,
    RolloutSize,
    episodes_per_env,
    steps_to_quota,
)
from sb3_crpn.episodes.batch import episode_starts
from tests.mdp import differs, random_mdp, random_parameters, tabular_crpn


@given(st.integers(1, 200), st.integers(1, 20))
@settings(deadline=None)
def test_episodes_are_spread_evenly(n_episodes, n_envs):
    quotas = episodes_per_env(n_episodes, n_envs)
    assert quotas.shape == (n_envs,)
    assert quotas.sum() == n_episodes
    assert quotas.max() - quotas.min() <= 1


def test_quota_from_steps():
    assert steps_to_quota(1000, None) == 1
    assert steps_to_quota(1000, 2000.0) == 1
    assert steps_to_quota(1000, 20.0) == 50


def begun(n_episodes, at_episode_start, horizon=None):
    tracker = EpisodeTracker()
    tracker.begin(RolloutSize(0, n_episodes, horizon), 1 - np.array(at_episode_start, int))
    return tracker


def run(tracker, dones):
    """The segments that end with these steps, as (env, start, length, truncated)."""
    segments = [end for row in dones for end in tracker.advance(np.array(row, bool))]
    assert all(segment.time == 0 for segment in segments)
    return [(s.env, s.start, s.length, s.cut) for s in segments]


def test_each_environment_delivers_its_first_episodes_however_long():
    tracker = begun(3, [True, True])
    assert run(tracker, [[1, 0], [0, 0]]) == [(0, 0, 1, False)]
    assert not tracker.complete
    assert run(tracker, [[1, 0], [1, 0], [1, 1]]) == [
        (0, 1, 2, False),
        (1, 0, 5, False),
    ]
    assert tracker.complete
    assert not tracker.needs_reset


def test_what_began_before_the_rollout_is_not_an_episode():
    tracker = begun(2, [False, True])
    ends = run(tracker, [[0, 0], [1, 0], [0, 1], [0, 1], [1, 0]])
    assert ends == [(1, 0, 3, False), (0, 2, 3, False)]


def test_the_horizon_cuts_and_a_restart_begins_the_next_episode():
    tracker = begun(3, [True, True], horizon=2)
    ends = run(tracker, [[0, 0], [1, 0]])
    assert ends == [(0, 0, 2, False), (1, 0, 2, True)]
    assert not tracker.needs_reset
    assert run(tracker, [[0, 0], [0, 1]]) == [(0, 2, 2, True)]
    assert tracker.complete

    tracker = begun(2, [True], horizon=2)
    run(tracker, [[0], [0], [0]])
    assert tracker.needs_reset
    tracker.restart()
    assert not tracker.needs_reset
    assert run(tracker, [[0], [0]]) == [(0, 3, 2, True)]


def test_an_environment_without_quota_is_ignored():
    tracker = begun(1, [True, True])
    assert run(tracker, [[0, 1], [0, 1]]) == []
    assert run(tracker, [[1, 1]]) == [(0, 0, 3, False)]


class FirstToFinish(ProgressTracker):
    """The biased selection: the first m episodes to finish of all environments."""

    def begin(self, size, times):
        super().begin(size, times)
        self._missing = size.n_episodes
        self._remaining[:] = self._missing
        self._recording = times == 0

    @property
    def complete(self):
        return self._missing == 0

    def advance(self, dones):
        for end in list(super().advance(dones))[: self._missing]:
            self._missing -= 1
            yield end


def lengths_and_returns(n_repeats=150, n_episodes=12):
    """Mean length and discounted return of the valid episodes, [n, 2], and the exact ones."""
    mdp = random_mdp(2, horizon=12)
    model = tabular_crpn(mdp, n_envs=8)
    theta = random_parameters(mdp)
    model.actor.assign(theta)
    means = []
    for _ in range(n_repeats):
        batch = model.estimate_curvature(n_episodes).gradient_batch
        assert batch.n_episodes == n_episodes
        first = batch.returns[episode_starts(batch.lengths)]
        means.append([batch.lengths.mean(), first.mean()])
    return means, [mdp.mean_length(theta), -mdp.cost(theta).item()]


def test_kept_episodes_are_not_biased_towards_short_ones(monkeypatch):
    assert not differs(*lengths_and_returns())
    monkeypatch.setattr(rollouts, "ProgressTracker", FirstToFinish)
    means, exact = lengths_and_returns()
    assert differs(means, exact)
    assert np.mean(means, axis=0)[0] < 0.9 * exact[0]
