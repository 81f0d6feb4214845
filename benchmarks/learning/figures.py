"""Pictures of a comparison: learning curves, and the aggregate over environments."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.common.figures import PALETTE, use_style
from benchmarks.common.intervals import Estimate
from benchmarks.learning.comparison import METRICS, Comparison
from benchmarks.learning.statistics import (
    Array,
    improvement,
    interquartile_mean,
    performance_profile,
    stratified_bootstrap,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = dict(
    zip(
        ("CRPN", "TRPO", "PPO", "A2C", "REINFORCE", "ACRPN", "CRPN-paper", "ACRPN-paper"),
        PALETTE,
        strict=True,
    )
)
DASHED = {"ACRPN", "PPO", "ACRPN-paper", "REINFORCE"}


def save_learning_curves(
    comparison: Comparison, tasks: Sequence[str], labels: Sequence[str], path: Path
) -> None:
    """Draw mean return over seeds, with its bootstrap interval, against environment steps."""
    figure, axes = _figure(1, len(tasks), size=(3.1 * len(tasks), 3.2))
    for ax, task in zip(axes, tasks, strict=True):
        for label in labels:
            _draw_curve(ax, comparison, label, task)
        ax.set(title=task, xlabel="thousand environment steps")
    axes[0].set_ylabel("return of episodes in training")
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=len(names))
    figure.savefig(path)


def _draw_curve(ax: Axes, comparison: Comparison, label: str, task: str) -> None:
    curves = comparison.learning_curves(label, task)
    if curves.empty:
        return
    steps = curves.index.to_numpy() / 1000
    mean, low, high = stratified_bootstrap([curves.to_numpy().T], lambda runs: runs[0].mean(0))
    ax.plot(steps, mean, label=label, **_line(label))
    ax.fill_between(steps, low, high, color=COLOURS.get(label), alpha=0.2, linewidth=0)


def save_aggregate(comparison: Comparison, path: Path) -> None:
    """Draw interquartile means, performance profile and probability of improvement.

    They are of the algorithms that ran wherever the baseline did.
    """
    labels = comparison.complete_learners
    figure, (left, middle, right) = _figure(1, 3, size=(12, 3.8))
    for i, metric in enumerate(METRICS):
        tasks = comparison.comparable_tasks(labels, metric)
        if not tasks:
            continue
        scores = comparison.scores(labels, tasks, metric)
        others = scores[comparison.baseline]
        for row, label in enumerate(labels):
            iqm = stratified_bootstrap(scores[label], interquartile_mean)
            _draw_estimate(left, row + 0.3 * i, iqm, label, filled=i == 0)
            if label != comparison.baseline:
                better = improvement(scores[label], others)
                _draw_estimate(right, row + 0.3 * i, better, label, filled=i == 0)
            if i == 0:
                _draw_profile(middle, scores[label], label)
    _finish_aggregate(figure, comparison.baseline, labels)
    figure.savefig(path)


def _draw_estimate(ax: Axes, place: float, estimate: Estimate, label: str, *, filled: bool) -> None:
    colour = COLOURS.get(label, "0.4")
    ax.plot([estimate.low, estimate.high], [place, place], color=colour, linewidth=2)
    ax.plot(estimate.value, place, "o", color=colour, mfc=colour if filled else "white")


def _draw_profile(ax: Axes, samples: Sequence[Array], label: str) -> None:
    thresholds = np.linspace(0, 2, 101)
    value, low, high = stratified_bootstrap(
        samples, lambda resampled: performance_profile(resampled, thresholds)
    )
    ax.plot(thresholds, value, label=label, **_line(label))
    ax.fill_between(thresholds, low, high, color=COLOURS.get(label), alpha=0.12, linewidth=0)


def _finish_aggregate(figure: Figure, baseline: str, labels: Sequence[str]) -> None:
    left, middle, right = figure.axes
    for ax in (left, right):
        ax.set_yticks(np.arange(len(labels)) + 0.15, labels)
        ax.set_ylim(len(labels) - 0.4, -0.3)
        ax.grid(axis="y", visible=False)
    for filled, name in zip(("k", "white"), METRICS.values(), strict=True):
        left.plot([], [], "o", color="k", mfc=filled, label=name)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower left", ncols=2)
    figure.legend(*middle.get_legend_handles_labels(), loc="outside lower right",
                  ncols=len(labels), fontsize="small")  # fmt: skip
    left.axvline(1, color="0.5", linestyle=":")
    left.set(title="interquartile mean", xlabel=f"score (0: random, 1: {baseline})")
    middle.set(
        title="performance profile",
        xlabel="τ (score of the mean return over training)",
        ylabel="fraction of runs with score > τ",
        ylim=(-0.02, 1.02),
    )
    right.axvline(0.5, color="0.5", linestyle=":")
    right.set(title=f"P(better than {baseline})", xlim=(-0.02, 1.02), xlabel="probability")


def _figure(n_rows: int, n_columns: int, size: tuple[float, float]) -> tuple[Figure, Any]:
    from matplotlib import pyplot as plt

    use_style()
    figure, axes = plt.subplots(n_rows, n_columns, figsize=size, layout="constrained")
    return figure, np.atleast_1d(axes)


def _line(label: str) -> dict[str, Any]:
    return {"color": COLOURS.get(label), "linestyle": "--" if label in DASHED else "-"}
