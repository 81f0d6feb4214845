"""Results in a CSV file that grows row by row."""

from __future__ import annotations

import csv
import fcntl
import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

Row = dict[str, Any]


@dataclass(frozen=True)
class Table:
    """Rows of results in a CSV file.

    Floats are kept with seven significant digits, which is more than they are good for; lists and
    dicts as JSON.

    Attributes
    ----------
    path
        The file; it need not exist.
    keys
        Columns that tell rows apart: of rows that agree in them the last one counts. Without keys
        every row counts.
    columns
        Those of a new file; by default its first row's.
    """

    path: Path
    keys: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()

    def append(self, rows: Sequence[Row]) -> None:
        """Append rows of the same columns in one write, so that a stop leaves none or all of them.

        A file that exists keeps its columns. Several processes may append.
        """
        if not rows:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a+", newline="", encoding="utf-8") as file:
            fcntl.flock(file, fcntl.LOCK_EX)  # until it is closed
            file.seek(0)
            header = next(csv.reader(file), None)
            file.write(self._text(rows, header))

    def replace(self, rows: Sequence[Row], **where: Any) -> None:
        """Put rows in place of those whose columns have the values ``where``."""
        kept = self.read().astype(object).to_dict("records")
        kept = [row for row in kept if any(row[key] != value for key, value in where.items())]
        self.path.write_text(self._text([*kept, *rows], None), encoding="utf-8")

    def read(self) -> pd.DataFrame:
        """Return all valid rows, or none without a file."""
        if not self.path.exists():
            return pd.DataFrame(columns=list(self.columns))
        # a setting, or the random policy's hyperparameters, may be the empty text
        frame = pd.read_csv(self.path, keep_default_na=False, na_values=["nan"])
        if not self.keys:
            return frame
        return frame.drop_duplicates(list(self.keys), keep="last", ignore_index=True)

    def missing(self, jobs: Iterable[Row]) -> list[Row]:
        """Return the jobs, the leading columns of a row, that no row has."""
        jobs = list(jobs)
        if not jobs or not self.path.exists():
            return jobs
        with self.path.open(newline="", encoding="utf-8") as file:
            done = {tuple(row[key] for key in jobs[0]) for row in csv.DictReader(file)}
        return [job for job in jobs if tuple(map(_cell, job.values())) not in done]

    def _text(self, rows: Sequence[Row], header: Sequence[str] | None) -> str:
        text = io.StringIO()
        columns = header or self.columns or list(rows[0])
        writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
        if header is None:
            writer.writeheader()
        writer.writerows({key: _cell(value) for key, value in row.items()} for row in rows)
        return text.getvalue()


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.7g}"
    if isinstance(value, (dict, list)):
        return json.dumps(_rounded(value))
    return str(value)


def _rounded(value: Any) -> Any:
    """Return nested JSON with its floats rounded."""
    if isinstance(value, dict):
        return {key: _rounded(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(part) for part in value]
    return float(f"{value:.7g}") if isinstance(value, float) else value
