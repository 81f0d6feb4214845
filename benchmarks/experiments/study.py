"""Shared by the experiments: a CSV that grows by jobs, a figure, and their command."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from benchmarks.common.figures import use_style
from benchmarks.common.pool import run_all
from benchmarks.common.table import Row, Table

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Study:
    """An experiment.

    Attributes
    ----------
    name
        Of the CSV, ``benchmarks/experiments/<name>.csv``, and the figure, ``docs/<name>.png``.
    jobs
        Number of seeds ↦ what to measure; a job is a row's leading columns, by which the CSV
        knows it again.
    measure
        Job ↦ its rows, without those columns. A function of a module, for worker processes.
    draw
        The whole CSV ↦ the figure; prints what the figure's text is taken from.
    seeds
        Default number of seeds.
    """

    name: str
    jobs: Callable[[int], list[Row]]
    measure: Callable[..., list[Row]]
    draw: Callable[[pd.DataFrame], Figure]
    seeds: int

    @property
    def table(self) -> Table:
        """Where the rows are kept."""
        return Table(ROOT / "benchmarks" / "experiments" / f"{self.name}.csv")

    def main(self, description: str) -> None:
        """Measure the missing jobs and draw the figure."""
        parser = argparse.ArgumentParser(description=description)
        parser.add_argument("--seeds", type=int, default=self.seeds)
        parser.add_argument("--jobs", type=int, default=1, help="processes")
        arguments = parser.parse_args()
        missing = self.table.missing(self.jobs(arguments.seeds))
        work = partial(_measure, self.measure)
        if missing and run_all(work, missing, self._keep, n_processes=arguments.jobs):
            sys.exit(1)
        use_style()
        figure = self.draw(self.table.read())
        figure.savefig(ROOT / "docs" / f"{self.name}.png", bbox_inches="tight")

    def _keep(self, job: Row, rows: list[Row]) -> None:
        self.table.append([job | row for row in rows])


def _measure(measure: Callable[..., list[Row]], job: Row) -> list[Row]:
    return measure(**job)
