"""Time to a level: which runs, when they stop, and what the tables say."""

from importlib.util import find_spec

import numpy as np
import pandas as pd
import pytest
import yaml

from benchmarks import wallclock
from benchmarks.common.table import Table
from benchmarks.wallclock import KEYS, Level, UntilLevel, jobs, make_job, tables
from sb3_crpn.zoo import config_file

pytestmark = pytest.mark.skipif(find_spec("rl_zoo3") is None, reason="needs the zoo extra")


def test_an_update_keeps_its_number_of_steps():
    published = make_job("PPO", "CartPole-v1", None, 3).run
    assert published.setting == ""
    n_envs, n_steps = (published.arguments[name] for name in ("n_envs", "n_steps"))
    job = make_job("PPO", "CartPole-v1", 2 * n_envs, 3)
    assert (job.n_envs, job.run.arguments["n_envs"]) == (2 * n_envs, 2 * n_envs)
    assert job.run.arguments["n_steps"] == n_steps // 2
    assert job.run.timesteps == published.arguments["n_timesteps"]
    assert make_job("PPO", "CartPole-v1", n_envs, 3).run == published


def test_arms_take_turns_within_a_seed():
    keys = [tuple(job.key.values()) for job in jobs(["Pendulum-v1"], ["CRPN", "PPO"], [8], 2)]
    assert keys == [
        ("Pendulum-v1", arm, n_envs, seed)
        for seed in range(2)
        for arm, n_envs in [("CRPN", 2), ("PPO", 4), ("CRPN", 8), ("PPO", 8)]
    ]


def test_it_stops_at_the_mean_of_the_latest_episodes():
    until = UntilLevel(Level(3.0, episodes=2))
    until._on_training_start()
    goes_on = []
    for returns in ([9.0], [], [1.0, 2.0], [3.9], [2.1]):
        until.locals = {"infos": [{}, *({"episode": {"r": value}} for value in returns)]}
        goes_on.append(until._on_step())
    until._on_training_end()
    # one episode is too few; then 1.5, 2.95 and 3.0
    assert goes_on == [True, True, True, True, False]
    assert until.reached
    assert until.wall > 0
    assert until.cpu > 0


def test_tables_compare_the_fastest_that_always_get_there():
    rows = [
        {"env": "CartPole-v1", "arm": arm, "n_envs": n_envs, "seed": seed, "reached": reached,
         "wall_seconds": wall, "cpu_seconds": 2 * wall, "steps": 1000}
        for arm, n_envs, wall, reached in [
            ("CRPN", 2, 8.0, 1), ("CRPN", 8, 4.0, 1), ("TRPO", 2, 1.0, 0), ("PPO", 8, 16.0, 1)
        ]
        for seed in range(3)
    ]  # fmt: skip
    rows.append(rows[0] | {"arm": "TRPO", "n_envs": 8, "wall_seconds": 0.1})  # one seed alone
    arms, best = tables(pd.DataFrame(rows))
    assert "| CartPole-v1: 475 | TRPO | 2 | 0 of 3 | > 1 | > 2 | > 1,000 |" in arms
    line = "| CartPole-v1: 475 | CRPN | 8 | 3 of 3 | 4.00 [4.00, 4.00] | 8.00 [8.00, 8.00] |"
    assert line in arms
    ratio = "0.25 [0.25, 0.25]"
    assert f"| CartPole-v1 | CRPN, 8 | PPO, 8 | {ratio} | {ratio} |" in best
    assert "TRPO" not in best


def test_crpn_has_entries_for_many_environments():
    run = make_job("CRPN", "CartPole-v1", 64, 0).run
    entry = yaml.safe_load(config_file("crpn_64_envs").read_text())["CartPole-v1"]
    assert {key: run.arguments[key] for key in entry} == entry
    assert make_job("CRPN", "CartPole-v1", 8, 0).run.setting == "n_envs=8,n_steps=64"
    assert "n_reused_rollouts" not in make_job("TRPO", "CartPole-v1", 64, 0).run.arguments


def test_the_command_measures_resumes_and_prints(tmp_path, monkeypatch, capsys):
    file = tmp_path / "wallclock.csv"
    monkeypatch.setattr(wallclock, "LEVELS", {"CartPole-v1": Level(9.0, episodes=2)})
    options = ["--arms", "CRPN", "PPO", "--n-envs", "1", "--seeds", "1", "--results", str(file)]
    monkeypatch.setattr("sys.argv", ["wallclock", *options])
    wallclock.main()
    rows = Table(file, KEYS).read()
    assert rows.reached.tolist() == [1] * 4
    assert set(zip(rows.arm, rows.n_envs, strict=True)) == {
        ("CRPN", 1), ("CRPN", 2), ("PPO", 1), ("PPO", 8)
    }  # fmt: skip
    assert rows.steps.between(18, 1000).all()
    assert np.isfinite(rows.wall_seconds).all()
    capsys.readouterr()
    wallclock.main()
    printed = capsys.readouterr().out
    assert "4 of 4 runs are done" in printed
    assert "| CartPole-v1: 9 | PPO | 8 | 1 of 1 |" in printed
