import matplotlib.pyplot as plt
import pandas as pd
import pytest

from benchmarks.experiments import study
from benchmarks.experiments.study import Study


def jobs(seeds):
    return [{"share": 3 * 2.65, "seed": seed} for seed in range(seeds)]


def measure(share, seed):
    return [{"value": share / 2 + seed}, {"value": seed}]


def draw(rows):
    figure, axis = plt.subplots()
    axis.plot(rows.seed, rows.value)
    return figure


@pytest.fixture
def halves(tmp_path, monkeypatch):
    (tmp_path / "docs").mkdir()
    monkeypatch.setattr(study, "ROOT", tmp_path)
    return Study("halves", jobs, measure, draw, seeds=2)


def test_the_command_measures_what_is_missing_and_draws_all(halves, tmp_path, monkeypatch):
    halves.table.append([{"share": 7.95, "seed": 0, "value": 1}])
    monkeypatch.setattr("sys.argv", ["halves"])
    halves.main("Halves.")
    expected = {"share": [7.95] * 3, "seed": [0, 1, 1], "value": [1, 4.975, 1]}
    pd.testing.assert_frame_equal(halves.table.read(), pd.DataFrame(expected), check_dtype=False)
    assert (tmp_path / "docs" / "halves.png").stat().st_size > 1000
