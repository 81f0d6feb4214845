import numpy as np
import pandas as pd
import pytest

from benchmarks.experiments import batches


@pytest.mark.parametrize("learner", list(batches.LEARNERS))
def test_updates_are_counted_until_the_level(learner, monkeypatch):
    monkeypatch.setitem(batches.UPDATES, 2_048, 1)
    (row,) = batches.measure("CartPole-v1", 2_048, learner, 0.02, 0)
    assert (row["updates"], row["reached"], len(row["curve"])) == (1, 0, 2)
    assert 12 < row["curve"][0] < 30  # the uniform policy's is 22


def test_no_update_is_made_at_the_level(monkeypatch):
    monkeypatch.setitem(batches.UPDATES, 2_048, 1)
    low = batches.TASKS["CartPole-v1"]._replace(level=10.0)
    monkeypatch.setitem(batches.TASKS, "CartPole-v1", low)
    (row,) = batches.measure("CartPole-v1", 2_048, "CRPN", 0.02, 0)
    assert (row["updates"], row["reached"], len(row["curve"])) == (0, 1, 1)


def _row(learner, kl, seed, updates, reached=1):
    return {
        "env": "Pendulum-v1", "batch": 2_048, "learner": learner, "target_kl": kl, "seed": seed,
        "updates": updates, "reached": reached, "curve": [-1000.0, -200.0],
    }  # fmt: skip


def test_each_learner_is_judged_at_its_best_target():
    rows = pd.DataFrame(
        [
            *(_row("CRPN", 0.02, seed, 30) for seed in range(2)),
            *(_row("CRPN", 0.08, seed, 10 + seed) for seed in range(2)),
            *(_row("TRPO", 0.02, seed, 20) for seed in range(2)),
            *(_row("TRPO", 0.08, seed, 150, reached=0) for seed in range(2)),
        ]
    )
    chosen = batches.best(rows)
    assert set(zip(chosen.learner, chosen.target_kl, strict=True)) == {
        ("CRPN", 0.08),
        ("TRPO", 0.02),
    }
    lines = batches.table(rows).splitlines()
    assert (
        lines[-1]
        == "| Pendulum-v1 | 2,048 | best | 10.5 [10.0, 11.0] | - | 20.0 [20.0, 20.0] | - |"
    )
    assert "150.0 [150.0, 150.0] (0 of 2)" in lines[3]


def test_of_equal_counts_the_better_curve_counts():
    rows = pd.DataFrame([_row("CRPN", kl, 0, 150, 0) for kl in (0.02, 0.08)])
    rows.at[1, "curve"] = [float("nan"), -900.0, -300.0]
    rows.at[0, "curve"] = [-900.0, -500.0]
    assert float(batches.best(rows).target_kl.iloc[0]) == 0.08
    assert np.isnan(batches.parse_curve("[NaN, -1.5]")[0])
