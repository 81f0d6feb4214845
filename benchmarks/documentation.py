"""The tables of README.md and docs/, and the README's picture, from the committed measurements.

    python -m benchmarks.documentation          # rewrite the tables in place
    python -m benchmarks.documentation --check  # fail where a page differs

A table stands between ``<!-- table: NAME -->`` and ``<!-- end -->``; NAME is a key of ``TABLES``.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path

from matplotlib.figure import Figure

from benchmarks import distributed, wallclock
from benchmarks.common.markdown import estimate, markdown
from benchmarks.common.table import Table
from benchmarks.learning import comparison, equal, rollouts, store, tables
from benchmarks.learning.comparison import Comparison
from benchmarks.learning.settings import TRPO_EQUAL
from benchmarks.learning.statistics import interquartile_mean, stratified_bootstrap
from sb3_crpn.theory.__main__ import table as theory_table

ROOT = Path(__file__).parents[1]
LEARNING = Path(__file__).parent / "learning"
# Columns of the table at equal settings: the labels of their runs
EQUAL_ARMS = {
    "CRPN": "CRPN",
    "ACRPN": "ACRPN",
    "CRPN, H = 0": "CRPN (hessian_shrinkage=0.0)",
    "TRPO": TRPO_EQUAL,
}
MIN_SEEDS = 3
BLOCK = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def main() -> None:
    """Write or check all pages."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.documentation",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--check", action="store_true", help="write nothing, fail on a difference")
    check = parser.parse_args().check
    stale = []
    for page in pages():
        text = page.read_text()
        written = render(text)
        if written != text:
            stale.append(str(page.relative_to(ROOT)))
            if not check:
                page.write_text(written)
    if not check:
        draw(ROOT / "docs" / "learning_curve.png")
    print("differ:" if check else "written:", ", ".join(stale) or "none")
    sys.exit(1 if check and stale else 0)


def pages() -> Iterator[Path]:
    """Yield the pages that hold a table."""
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        if BLOCK.search(page.read_text()):
            yield page


def render(text: str) -> str:
    """Return a page with all its tables generated again."""
    return BLOCK.sub(lambda block: f"{block[1]}{TABLES[block[2]]()}\n{block[3]}", text)


@cache
def _results(folder: str, baseline: str) -> Comparison:
    return comparison.load(LEARNING / folder, baseline)


def published() -> str:
    """CRPN, ACRPN and TRPO, each with its published entry: the whole table."""
    found = _results(store.RESULTS.name, "TRPO")
    head = ["environment", "seeds", "CRPN, mean", "ACRPN, mean", "TRPO, mean", "CRPN, final",
            "TRPO, final", "CRPN's CPU time / TRPO's"]  # fmt: skip
    rows = []
    for task in found.tasks:
        seeds = str(len(found.values("CRPN", task, "mean_return")))
        means = _cells(found, ("CRPN", "ACRPN", "TRPO"), task, "mean_return")
        finals = _cells(found, ("CRPN", "TRPO"), task, "final_return")
        cost = tables.mean_cell(found.paired_ratios("CRPN", task, "cpu_seconds"), ",.2f")
        rows.append([task, seeds, *means, *finals, cost])
    return markdown(head, rows)


def headline() -> str:
    """Mean returns over training at equal settings; while none are measured, of the entries."""
    found = equal.load()
    body = []
    for task in found.tasks:
        n_seeds = len(found.values(TRPO_EQUAL, task, "mean_return"))
        if n_seeds >= MIN_SEEDS:
            cells = _cells(found, list(EQUAL_ARMS.values()), task, "mean_return")
            body.append([task, n_seeds, *cells])
    if not body:
        note = "Mean return over training, each algorithm with its published hyperparameters."
        return f"{note}\n\n{_entries()}"
    note = (
        "Mean return over training. All arms have CRPN's hyperparameters: environments, timesteps "
        "of an update, γ, λ, network, first noise, KL target and critic work."
    )
    return f"{note}\n\n{markdown(['environment', 'seeds', *EQUAL_ARMS], body)}"


def _entries() -> str:
    found = _results(store.RESULTS.name, "TRPO")
    learners = ("CRPN", "ACRPN", "TRPO")
    head, rows = ["environment", "seeds", *learners], []
    for task in found.tasks:
        seeds = str(len(found.values("CRPN", task, "mean_return")))
        rows.append([task, seeds, *_cells(found, learners, task, "mean_return")])
    return markdown(head, rows)


def learners() -> str:
    """Mean return over training of every learner, on the environments that most of them ran on."""
    found = _results(store.RESULTS.name, "TRPO")
    tasks = found.tasks[:7]
    head, rows = ["mean return over training", *tasks], []
    for label in found.learners:
        rows.append([label, *(_cells(found, (label,), task, "mean_return")[0] for task in tasks)])
    return markdown(head, rows)


def ablation() -> str:
    """One default changed at a time: interquartile means of normalised scores."""
    found = _results("ablation", "CRPN (defaults)")
    tasks = found.comparable_tasks(found.learners, "mean_return")
    scores = found.scores(found.learners, tasks, "mean_return")
    head, rows = ["changed", "IQM", *(task.split(" (")[0] for task in tasks)], []
    for label in found.learners:
        mean = estimate(stratified_bootstrap(scores[label], interquartile_mean))
        cells = (_cells(found, (label,), task, "mean_return")[0] for task in tasks)
        changed = re.sub(r"^CRPN \(defaults,?(.*)\)$", r"`\1`", label).replace(",", ", ")
        rows.append([changed if label != found.baseline else "nothing", mean, *cells])
    return markdown(head, rows)


def ranks() -> str:
    """Return the times of several ranks and of one process, and the cost model."""
    return "\n\n".join(distributed.tables(distributed.RESULTS.read()))


def compared_rollouts() -> str:
    """Return by how much whole episodes and timesteps differ, and what each reaches."""
    runs = store.read_runs(rollouts.RESULTS)
    return f"{rollouts.differences(runs)}\n\n{rollouts.table(runs)}"


def many_environments() -> str:
    """Return the settings that were tried for 16 and 64 environments."""
    return rollouts.table(store.read_runs(LEARNING / "many"))


def seconds_to_a_level() -> str:
    """Return the times of all arms, and CRPN's best in the best peer's."""
    return "\n\n".join(wallclock.tables(Table(wallclock.RESULTS, wallclock.KEYS).read()))


def _cells(found: Comparison, labels: Sequence[str], task: str, column: str) -> list[str]:
    return [tables.mean_cell(found.values(label, task, column)) for label in labels]


def draw(path: Path) -> None:
    """Draw CRPN's default settings on CartPole-v1: each seed, and their mean."""
    found = _results("ablation", "CRPN (defaults)")
    curves = found.learning_curves(found.baseline, "CartPole-v1 (50,000 steps)")
    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    axes = figure.subplots()
    axes.axhline(475, color="gray", ls="--", lw=1, label="solved: 475")
    axes.plot(curves.index, curves, color="C0", lw=1, alpha=0.4)
    axes.plot(curves.index, curves.mean(axis=1), color="C0", lw=2, label="mean of the seeds")
    axes.set(xlabel="timesteps", ylabel="return of training episodes", ylim=(0, 520))
    axes.set_title(f"CRPN on CartPole-v1, default settings, {curves.shape[1]} seeds")
    axes.legend(loc="lower right")
    figure.savefig(path, dpi=120)


TABLES: dict[str, Callable[[], str]] = {
    "ablation": ablation,
    "distributed": ranks,
    "headline": headline,
    "learners": learners,
    "many": many_environments,
    "published": published,
    "rollouts": compared_rollouts,
    "theory": theory_table,
    "wallclock": seconds_to_a_level,
}

if __name__ == "__main__":
    main()
