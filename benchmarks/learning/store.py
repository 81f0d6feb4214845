"""The two tidy CSV files of a results folder: one row per run, one row per point of a curve."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from benchmarks.common.table import Table
from benchmarks.learning.run import Result, Run
from benchmarks.learning.settings import same_hyperparameters

RESULTS = Path(__file__).parent / "results"

KEYS = ("algo", "env", "setting", "timesteps", "seed")
RUN_COLUMNS = (
    *KEYS,
    "mean_return",
    "final_return",
    "steps",
    "episodes",
    "updates",
    "wall_seconds",
    "cpu_seconds",
    "entry",
    "hyperparameters",
    "versions",
)
CURVE_COLUMNS = (*KEYS, "steps", "return")


def append(folder: Path, run: Run, result: Result) -> None:
    """Store a finished run: its curve, then the row that makes it count as done."""
    key = {name: getattr(run, name) for name in KEYS}
    points = [{**key, "steps": steps, "return": value} for steps, value in result.curve]
    _curves(folder).append(points)
    names = {"entry": run.entry, "hyperparameters": run.hyperparameters}
    _runs(folder).append([{**key, **result.row, **names}])


def read_runs(folder: Path) -> pd.DataFrame:
    """Return the rows of all runs, the latest where one was repeated."""
    return _runs(folder).read()


def read_curves(folder: Path) -> pd.DataFrame:
    """Return the points of all curves, of the latest run where one was repeated."""
    return _curves(folder).read()


def is_done(run: Run, done: pd.DataFrame) -> bool:
    """Return whether ``done``, rows of runs, has this one with the same hyperparameters."""
    return bool((matches(run, done) & (done["setting"] == run.setting)).any())


def matches(run: Run, rows: pd.DataFrame) -> pd.Series:
    """Return the mask of rows with this run's hyperparameters, for every name of a setting."""
    keys = [name for name in KEYS if name != "setting"]
    found = (rows[keys] == [getattr(run, name) for name in keys]).all(axis=1)
    for index in found.index[found]:
        description = rows.loc[index, "hyperparameters"]
        found[index] = same_hyperparameters(run.hyperparameters, description)
    return found


def _runs(folder: Path) -> Table:
    return Table(folder / "runs.csv", KEYS, RUN_COLUMNS)


def _curves(folder: Path) -> Table:
    return Table(folder / "curves.csv", (*KEYS, "steps"), CURVE_COLUMNS)
