"""A comparison from the CSV files: groups of runs, normalised scores, steps to a level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from benchmarks.common.intervals import interval
from benchmarks.learning import store
from benchmarks.learning.settings import ALGORITHMS, BUDGETS, RANDOM, same_hyperparameters
from benchmarks.learning.statistics import Array

METRICS = {"mean_return": "mean return over training", "final_return": "final return"}

# Bins of the moving average for levels, a tenth of the budget
WINDOW = 5

Scores = dict[str, list[Array]]  # by algorithm, an array of seeds for each environment


@dataclass(frozen=True)
class Comparison:
    """All runs of a results folder.

    Attributes
    ----------
    runs, curves
        The files' rows, with the columns ``label`` (algorithm and setting) and ``task``
        (environment, and budget where it is not the benchmark's).
    baseline
        Label of the algorithm that the others are compared with.
    n_outdated
        Rows left out because later runs of the same algorithm and task have other hyperparameters.
    """

    runs: pd.DataFrame
    curves: pd.DataFrame
    baseline: str
    n_outdated: int

    @property
    def labels(self) -> list[str]:
        """Algorithms, in the benchmark's order."""
        order = [*ALGORITHMS, RANDOM]
        found = self.runs[["algo", "label"]].drop_duplicates()
        return list(
            found.sort_values("algo", key=lambda c: c.map(order.index), kind="stable").label
        )

    @property
    def learners(self) -> list[str]:
        """Algorithms without the random policy."""
        return [label for label in self.labels if label != RANDOM]

    @property
    def complete_learners(self) -> list[str]:
        """Algorithms that ran wherever the baseline did."""
        tasks = self.runs.groupby("label")["task"].agg(set)
        needed = tasks.get(self.baseline, set())
        return [label for label in self.learners if needed <= tasks[label]]

    @property
    def tasks(self) -> list[str]:
        """Environments, in the benchmark's order."""
        order = {env: i for i, env in enumerate(BUDGETS)}
        found = self.runs[["env", "task"]].drop_duplicates()
        by_order = found.sort_values(
            "env", key=lambda c: c.map(lambda env: order.get(env, len(order))), kind="stable"
        )
        return list(by_order.task)

    def values(self, label: str, task: str, column: str) -> Array:
        """Return a column's values over seeds, in the order of the seeds."""
        rows = self.runs[(self.runs.label == label) & (self.runs.task == task)]
        return rows.sort_values("seed")[column].to_numpy(float)

    def paired_ratios(self, label: str, task: str, column: str) -> Array:
        """Return a column's ratios to the baseline's, of runs with the same seed."""
        rows = self.runs[self.runs.task == task].set_index("seed")
        ratios = rows[rows.label == label][column] / rows[rows.label == self.baseline][column]
        return ratios.dropna().to_numpy(float)

    def learning_curves(self, label: str, task: str) -> pd.DataFrame:
        """Return the curves, indexed by steps, a column for each seed; gaps are interpolated."""
        rows = self.curves[(self.curves.label == label) & (self.curves.task == task)]
        curves = rows.pivot(index="steps", columns="seed", values="return")
        return curves.interpolate(limit_direction="both")

    def level(self, task: str) -> float:
        """Return the baseline's mean return at the end of training: over its last tenth."""
        return float(self.learning_curves(self.baseline, task).tail(WINDOW).to_numpy().mean())

    def steps_to_level(self, label: str, task: str) -> Array:
        """Return each run's steps until its curve, averaged over a tenth, is at the level.

        Infinite for runs that never are.
        """
        smooth = self.learning_curves(label, task).rolling(WINDOW, min_periods=1).mean()
        reached = smooth >= self.level(task)
        return np.where(reached.any(), reached.idxmax(), np.inf).astype(float)

    def comparable_tasks(self, labels: Sequence[str], column: str) -> list[str]:
        """Return the tasks that all of ``labels`` ran on and whose scores have a scale."""
        return [
            task
            for task in self.tasks
            if all(len(self.values(label, task, column)) for label in (*labels, self.baseline))
            and self.has_scale(task, column)
        ]

    def has_scale(self, task: str, column: str) -> bool:
        """Return whether the baseline is better than the random policy beyond chance."""
        random = self.values(RANDOM, task, column)
        baseline = self.values(self.baseline, task, column)
        if not len(random) or not len(baseline):
            return False
        found = interval(baseline, method="BCa")
        low = found.low if len(baseline) > 1 else found.value
        return low > random.mean()

    def scores(self, labels: Sequence[str], tasks: Sequence[str], column: str) -> Scores:
        """Return (x - random) / (baseline - random) of each run x, with means over seeds.

        Returns can be negative, so that a ratio would say nothing: the random policy is the zero,
        the baseline's mean is 1.
        """
        zeros = [self.values(RANDOM, task, column).mean() for task in tasks]
        ones = [self.values(self.baseline, task, column).mean() for task in tasks]
        return {
            label: [
                (self.values(label, task, column) - zero) / (one - zero)
                for task, zero, one in zip(tasks, zeros, ones, strict=True)
            ]
            for label in labels
        }


def load(folder: Path, baseline: str) -> Comparison:
    """Read a results folder."""
    return compare(store.read_runs(folder), store.read_curves(folder), baseline)


def compare(runs: pd.DataFrame, curves: pd.DataFrame, baseline: str) -> Comparison:
    """Return the comparison of rows of runs, of which outdated ones are left out."""
    is_current = _are_current(runs)
    keys = list(store.KEYS)
    curves = curves.merge(runs.loc[is_current, keys], on=keys)
    frames = [_with_names(frame) for frame in (runs[is_current], curves)]
    return Comparison(frames[0], frames[1], baseline, int((~is_current).sum()))


def _are_current(runs: pd.DataFrame) -> pd.Series:
    """Return the mask of rows with the hyperparameters of the last one of their group."""
    groups = runs.groupby(["algo", "env", "setting", "timesteps"])["hyperparameters"]
    latest = groups.transform("last")
    agree = [same_hyperparameters(a, b) for a, b in zip(runs.hyperparameters, latest, strict=True)]
    return pd.Series(agree, index=runs.index, dtype=bool)


def _with_names(frame: pd.DataFrame) -> pd.DataFrame:
    label = frame.algo + frame.setting.map(lambda setting: f" ({setting})" if setting else "")
    usual = frame.env.map(BUDGETS) == frame.timesteps
    task = frame.env + frame.timesteps.map(" ({:,} steps)".format).where(~usual, "")
    return frame.assign(label=label, task=task)
