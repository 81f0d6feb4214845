"""Markdown tables of a comparison."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from benchmarks.common.intervals import interval
from benchmarks.common.markdown import estimate, markdown
from benchmarks.learning.comparison import METRICS, Comparison
from benchmarks.learning.settings import RANDOM
from benchmarks.learning.statistics import (
    Array,
    improvement,
    interquartile_mean,
    stratified_bootstrap,
)


def report(comparison: Comparison) -> str:
    """Return all tables."""
    parts = [
        "# Learning compared",
        "Returns are raw returns of whole episodes. Mean return over training: every environment "
        "step counts the return of its episode; final return: the deterministic policy, 20 "
        "episodes. Means over seeds, with 95 % bootstrap intervals.",
    ]
    if comparison.n_outdated:
        parts.append(f"{comparison.n_outdated} runs with outdated hyperparameters are left out.")
    parts += ["## Aggregate", aggregate_table(comparison, comparison.complete_learners)]
    if comparison.complete_learners != comparison.learners:
        parts += [
            f"Fewer environments, on which algorithms ran that did not on all of "
            f"{comparison.baseline}'s:",
            aggregate_table(comparison, comparison.learners),
        ]
    parts += ["## Each environment", task_table(comparison)]
    parts += ["## Cost", cost_table(comparison)]
    parts += ["## Hyperparameters", entry_table(comparison)]
    return "\n\n".join(parts) + "\n"


def aggregate_table(
    comparison: Comparison,
    labels: Sequence[str],
    means: Mapping[str, Callable[[Sequence[Array]], float]] = {"IQM": interquartile_mean},
) -> str:
    """Return means of normalised scores, by name, and probabilities of improvement."""
    baseline = comparison.baseline
    notes, columns = [], []
    for metric, name in METRICS.items():
        tasks = comparison.comparable_tasks(labels, metric)
        notes.append(f"{name}: {', '.join(tasks) or 'none'}")
        if not tasks:
            continue
        scores = comparison.scores(labels, tasks, metric)
        for mean_name, mean in means.items():
            found = [stratified_bootstrap(scores[label], mean) for label in labels]
            columns.append([f"{mean_name}, {name}", *map(estimate, found)])
        better = [
            "-" if label == baseline else estimate(improvement(scores[label], scores[baseline]))
            for label in labels
        ]
        columns.append([f"P(better than {baseline}), {name}", *better])
    head, *body = zip(["algorithm", *labels], *columns, strict=True)
    text = (
        f"Scores are (return - random) / ({baseline} - random): the random policy is 0, "
        f"{baseline}'s mean is 1. Interquartile mean (IQM) and probability of a better run than "
        f"{baseline}'s, every environment weighing the same; stratified bootstrap. Over the "
        f"environments that all of these ran on and where {baseline} is better than random beyond "
        f"chance — {'; '.join(notes)}."
    )
    return text + "\n\n" + markdown(head, body)


def task_table(comparison: Comparison) -> str:
    """Return mean and final return and the steps to the baseline's level, per environment."""
    baseline = comparison.baseline
    header = [
        "environment",
        "algorithm",
        "seeds",
        *METRICS.values(),
        f"steps to {baseline}'s level",
    ]
    rows: list[list[str]] = []
    for task in comparison.tasks:
        for label in comparison.labels:
            means = comparison.values(label, task, "mean_return")
            if not len(means):
                continue
            final = comparison.values(label, task, "final_return")
            has_level = label != RANDOM and comparison.has_scale(task, "mean_return")
            steps = _steps_cell(comparison, label, task) if has_level else "-"
            rows.append([task, label, str(len(means)), mean_cell(means), mean_cell(final), steps])
    text = (
        f"The level is {baseline}'s own return over the last tenth of training; a run is there "
        "when its learning curve, averaged over a tenth of the budget, is. Median over runs "
        f"(how many got there); no level where {baseline} is not better than random."
    )
    return text + "\n\n" + markdown(header, rows)


def cost_table(comparison: Comparison) -> str:
    """Return wall and CPU time of training, and ratios to the baseline's."""
    baseline = comparison.baseline
    header = ["environment", "algorithm", "wall, s", "CPU, s", f"wall / {baseline}'s",
              f"CPU / {baseline}'s"]  # fmt: skip
    rows: list[list[str]] = []
    for task in comparison.tasks:
        for label in comparison.labels:
            wall = comparison.values(label, task, "wall_seconds")
            if not len(wall) or label == RANDOM:
                continue
            cells = [mean_cell(wall), mean_cell(comparison.values(label, task, "cpu_seconds"))]
            for column in ("wall_seconds", "cpu_seconds"):
                cells.append(mean_cell(comparison.paired_ratios(label, task, column), spec=",.2f"))
            rows.append([task, label, *cells])
    text = (
        "Training alone, one thread. Ratios are of runs with the same seed: of one command, they "
        "ran next to each other. Other work on the machine moves wall time, CPU time less."
    )
    return text + "\n\n" + markdown(header, rows)


def entry_table(comparison: Comparison) -> str:
    """Return the origin of the hyperparameters."""
    labels, runs = comparison.learners, comparison.runs
    rows: list[list[str]] = []
    for task in comparison.tasks:
        entries = [runs[(runs.task == task) & (runs.label == label)].entry for label in labels]
        rows.append([task, *(found.iloc[-1] if len(found) else "-" for found in entries)])
    text = (
        "File and entry: a2c.yml, ppo.yml and trpo.yml are rl-zoo's; where it has no entry for the "
        "environment, the nearest. The others are this repository's, `zoo_configs/`."
    )
    return text + "\n\n" + markdown(["environment", *labels], rows)


def mean_cell(values: Array, spec: str | None = None) -> str:
    """Return ``mean [low, high]`` of runs; by default with three significant digits."""
    if not len(values):
        return "-"
    return estimate(interval(values, method="BCa"), spec)


def _steps_cell(comparison: Comparison, label: str, task: str) -> str:
    steps = comparison.steps_to_level(label, task)
    if not len(steps):
        return "-"
    budget = float(comparison.curves[comparison.curves.task == task].steps.max())
    # a bound at the budget means: the budget or more
    found = interval(np.minimum(steps, budget), statistic=np.median)
    median = f"> {budget:,.0f}" if np.isinf(np.median(steps)) else estimate(found, ",.0f")
    return f"{median} ({np.isfinite(steps).sum()}/{len(steps)})"
