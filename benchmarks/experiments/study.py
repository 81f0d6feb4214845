"""What the experiments share: a CSV that grows job by job, intervals, and the look of figures."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from scipy.stats import bootstrap
from tqdm import tqdm

ROOT = Path(__file__).parents[2]
Row = dict[str, Any]

# Okabe and Ito's colours, which colour-blind readers tell apart
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")
STYLE = {
    "figure.dpi": 150,
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "legend.frameon": False,
    "legend.fontsize": 8,
}


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
    def csv(self) -> Path:
        """Where the rows are kept."""
        return ROOT / "benchmarks" / "experiments" / f"{self.name}.csv"

    def main(self, description: str) -> None:
        """Measure what the CSV lacks and draw the figure."""
        parser = argparse.ArgumentParser(description=description)
        parser.add_argument("--seeds", type=int, default=self.seeds)
        parser.add_argument("--jobs", type=int, default=1, help="processes")
        arguments = parser.parse_args()
        self._run(self._missing(self.jobs(arguments.seeds)), arguments.jobs)
        with plt.rc_context(STYLE):
            # a setting may be the empty text
            figure = self.draw(pd.read_csv(self.csv, keep_default_na=False, na_values=["nan"]))
            figure.savefig(ROOT / "docs" / f"{self.name}.png", bbox_inches="tight")

    def _missing(self, jobs: list[Row]) -> list[Row]:
        if not self.csv.exists():
            return jobs
        with self.csv.open() as file:
            done = {tuple(row[key] for key in jobs[0]) for row in csv.DictReader(file)}
        return [job for job in jobs if tuple(map(_short, job.values())) not in done]

    def _run(self, jobs: list[Row], n_processes: int) -> None:
        with ProcessPoolExecutor(n_processes, get_context("spawn"), _one_thread) as pool:
            futures = {pool.submit(self.measure, **job): job for job in jobs}
            for future in tqdm(as_completed(futures), total=len(futures), desc=self.name):
                self._append([futures[future] | row for row in future.result()])

    def _append(self, rows: list[Row]) -> None:
        is_new = not self.csv.exists()
        with self.csv.open("a", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            if is_new:
                writer.writeheader()
            writer.writerows({key: _short(value) for key, value in row.items()} for row in rows)


def _one_thread() -> None:
    torch.set_num_threads(1)


def _short(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def interval(
    *samples: ArrayLike, statistic: Callable[..., Any] = np.median, level: float = 0.95
) -> tuple[float, float, float]:
    """Return a statistic of independent samples and its percentile-bootstrap interval."""
    data = tuple(np.asarray(sample, dtype=float) for sample in samples)
    value = float(statistic(*data))
    if all(np.ptp(sample) == 0 for sample in data):
        return value, value, value
    result = bootstrap(
        data,
        statistic,
        vectorized=False,
        n_resamples=2000,
        method="percentile",
        confidence_level=level,
        rng=np.random.default_rng(0),
    ).confidence_interval
    return value, float(result.low), float(result.high)


def ratio_of_medians(first: Sequence[float], second: Sequence[float]) -> float:
    """Return median(first) / median(second)."""
    return float(np.median(first) / np.median(second))
