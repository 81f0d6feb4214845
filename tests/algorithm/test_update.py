import numpy as np
import pytest

from sb3_crpn.algorithm.update import UpdateData
from tests.policies import frozen_episodes, small_policy

N_FRESH, N_EARLIER = 6, 2


def data_of(n_earlier):
    """Episodes whose lengths tell them apart: 1 to 6 steps, and 11, 12, … the earlier ones."""
    policy = small_policy("discrete")[0]
    fresh = frozen_episodes(policy, lengths=range(1, N_FRESH + 1))
    earlier = [frozen_episodes(policy, lengths=(11 + k,)) for k in range(n_earlier)]
    return UpdateData(fresh, earlier)


@pytest.mark.parametrize("n_earlier", [0, N_EARLIER])
@pytest.mark.parametrize(("m", "b"), [(2, 4), (4, 2), (6, 6), (None, 3), (3, None), (3, 9)])
def test_each_derivative_gets_its_episodes_and_the_earlier_ones(m, b, n_earlier):
    data = data_of(n_earlier)
    earlier = [11 + k for k in range(n_earlier)]
    batch, hessian_batch, fisher_batch = data.draw(m, b, np.random.default_rng(0))
    hessian_batch, fisher_batch = hessian_batch or batch, fisher_batch or batch
    n_hessian = min(b, N_FRESH) if b else m or N_FRESH
    for drawn, number, joined in (
        (batch, min(m or N_FRESH, N_FRESH), earlier),
        (hessian_batch, n_hessian, earlier),
        (fisher_batch, min(m or N_FRESH, N_FRESH), []),
    ):
        fresh, rest = drawn.lengths[:number], drawn.lengths[number:]
        assert len(set(fresh)) == number
        assert set(fresh) <= set(range(1, N_FRESH + 1))
        assert rest.tolist() == joined


def test_episodes_are_drawn_at_random():
    data, rng = data_of(0), np.random.default_rng(0)
    counts = sum(np.bincount(data.draw(2, None, rng)[0].lengths, minlength=7) for _ in range(600))
    assert counts[1:].sum() == 1200
    assert np.abs(counts[1:] - 200).max() < 5 * np.sqrt(600 * (2 / 6) * (4 / 6))
