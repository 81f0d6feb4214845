"""The two tidy CSV files of a results folder: one row per run, one row per point of a curve."""

from __future__ import annotations

import csv
import fcntl
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

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
    folder.mkdir(parents=True, exist_ok=True)
    key = {name: getattr(run, name) for name in KEYS}
    points = [{**key, "steps": steps, "return": value} for steps, value in result.curve]
    _append_rows(folder / "curves.csv", CURVE_COLUMNS, points)
    names = {"entry": run.entry, "hyperparameters": run.hyperparameters}
    _append_rows(folder / "runs.csv", RUN_COLUMNS, [{**key, **result.row, **names}])


def read_runs(folder: Path) -> pd.DataFrame:
    """Return the rows of all runs, the latest where one was repeated."""
    return _read(folder / "runs.csv", RUN_COLUMNS, list(KEYS))


def read_curves(folder: Path) -> pd.DataFrame:
    """Return the points of all curves, of the latest run where one was repeated."""
    return _read(folder / "curves.csv", CURVE_COLUMNS, [*KEYS, "steps"])


def is_done(run: Run, done: pd.DataFrame) -> bool:
    """Return whether ``done``, rows of runs, has this one with the same hyperparameters."""
    keys = [getattr(run, name) for name in KEYS]
    rows = done[(done[list(KEYS)] == keys).all(axis=1)]
    return any(same_hyperparameters(run.hyperparameters, row) for row in rows["hyperparameters"])


def _read(path: Path, columns: Sequence[str], keys: list[str]) -> pd.DataFrame:
    if not path.exists():
        return pd.DataFrame(columns=list(columns))
    # a setting, or the random policy's hyperparameters, may be the empty text
    frame = pd.read_csv(path, keep_default_na=False, na_values=["nan"])
    return frame.drop_duplicates(keys, keep="last", ignore_index=True)


def _append_rows(path: Path, columns: Sequence[str], rows: Iterable[dict[str, Any]]) -> None:
    """Append all rows in one write, so that a run that is stopped leaves none or all of them.

    A file made by another version keeps its columns.
    """
    with path.open("a+", newline="") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # until it is closed
        file.seek(0)
        header = next(csv.reader(file), None)
        text = io.StringIO()
        writer = csv.DictWriter(text, header or columns, extrasaction="ignore", lineterminator="\n")
        if header is None:
            writer.writeheader()
        writer.writerows({key: _short(value) for key, value in row.items()} for row in rows)
        file.write(text.getvalue())


def _short(value: Any) -> Any:
    """Return floats with seven significant digits, which is more than they are good for."""
    return f"{value:.7g}" if isinstance(value, float) else value
