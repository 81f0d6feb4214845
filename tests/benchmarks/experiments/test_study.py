import numpy as np
import pytest

from benchmarks.experiments import study
from benchmarks.experiments.study import Study, interval, ratio_of_medians


@pytest.fixture
def halves(tmp_path, monkeypatch):
    (tmp_path / "benchmarks" / "experiments").mkdir(parents=True)
    monkeypatch.setattr(study, "ROOT", tmp_path)
    return Study("halves", jobs, measure=None, draw=None, seeds=2)


def jobs(seeds):
    return [{"share": 3 * 2.65, "seed": seed} for seed in range(seeds)]


def test_what_the_csv_holds_is_not_measured_again(halves):
    first, second = jobs(2)
    assert halves._missing(jobs(2)) == [first, second]
    halves._append([first | {"value": 1 / 3}, first | {"value": 2.0}])
    assert halves._missing(jobs(2)) == [second]
    halves._append([second | {"value": 4}])
    assert halves._missing(jobs(2)) == []
    assert halves._missing(jobs(3)) == [jobs(3)[2]]
    assert halves.csv.read_text().split() == [
        "share,seed,value",
        "7.95,0,0.333333",
        "7.95,0,2",
        "7.95,1,4",
    ]


def test_intervals_cover_the_mean_as_often_as_they_say():
    rng = np.random.default_rng(0)
    bands = [interval(rng.normal(size=40), statistic=np.mean) for _ in range(40)]
    middle, low, high = np.array(bands).T
    assert 0.8 <= np.mean((low <= 0) & (high >= 0)) <= 0.99
    assert ((low <= middle) & (middle <= high)).all()


def test_intervals_of_constants_and_ratios():
    assert interval([3, 3, 3]) == (3, 3, 3)
    ratio, low, high = interval([2, 4, 6, 8], [1, 1, 1], statistic=ratio_of_medians)
    assert ratio == 5
    assert 2 <= low <= 5 <= high <= 8
