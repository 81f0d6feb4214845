import numpy as np
import pytest
from scipy import stats

from benchmarks.common.intervals import interval, ratio_of_medians


@pytest.mark.parametrize("method", ["percentile", "BCa"])
def test_intervals_cover_the_mean_as_often_as_they_say(method):
    rng = np.random.default_rng(0)
    bands = [interval(rng.normal(size=40), method=method) for _ in range(40)]
    middle, low, high = np.array(bands).T
    assert 0.8 <= np.mean((low <= 0) & (high >= 0)) <= 0.99
    assert ((low <= middle) & (middle <= high)).all()


def test_the_interval_of_a_mean_is_the_normal_one_for_many_values():
    values = np.random.default_rng(2).normal(size=400)
    mean, low, high = interval(values)
    assert mean == values.mean()
    assert high - low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.1)


def test_the_interval_of_a_median_is_near_that_of_order_statistics():
    """The k-th smallest and largest miss the median with probability 2 P(Binomial(n, ½) < k)."""
    values = np.random.default_rng(3).normal(size=200)
    k = int(stats.binom.ppf(0.025, 200, 0.5))
    exact = np.sort(values)[[k - 1, -k]]
    found = interval(values, statistic=np.median)
    assert found.value == np.median(values)
    assert found[1:] == pytest.approx(exact, abs=0.1)


def test_constants_have_no_width_and_one_value_alone_has_no_interval():
    assert interval([3, 3, 3]) == (3, 3, 3)
    value, low, high = interval([3])
    assert value == 3
    assert np.isnan([low, high]).all()


def test_a_ratio_resamples_both_sides():
    ratio, low, high = interval([2, 4, 6, 8], [1, 1, 1], statistic=ratio_of_medians)
    assert ratio == 5
    assert 2 <= low <= 5 <= high <= 8
    assert low < high
