"""The tables of README.md and docs/, from the committed measurements.

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

import pandas as pd

from benchmarks.learning import comparison, store, tables
from benchmarks.learning.comparison import Comparison
from benchmarks.learning.settings import BUDGETS
from benchmarks.learning.statistics import interquartile_mean, stratified_bootstrap

ROOT = Path(__file__).parents[1]
LEARNING = Path(__file__).parent / "learning"
# Columns of the table at equal settings: algorithm and setting of their rows
EQUAL_ARMS = {
    "CRPN": ("CRPN", ""),
    "ACRPN": ("ACRPN", ""),
    "CRPN, H = 0": ("CRPN", "hessian_shrinkage=0.0"),
    "TRPO": ("TRPO-equal", ""),
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
    print("differ:" if check else "written:", ", ".join(stale) or "none")
    sys.exit(1 if check and stale else 0)


def pages() -> Iterator[Path]:
    """Yield the pages that hold a table."""
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        if BLOCK.search(page.read_text()):
            yield page


def render(text: str) -> str:
    """Return a page with all its tables made anew."""
    return BLOCK.sub(lambda block: f"{block[1]}{TABLES[block[2]]()}\n{block[3]}", text)


@cache
def _results(folder: str, baseline: str) -> Comparison:
    return comparison.load(LEARNING / folder, baseline)


def published() -> str:
    """CRPN, ACRPN and TRPO, each with its published entry: the whole table."""
    found = _results(store.RESULTS.name, "TRPO")
    rows = [
        ["environment", "seeds", "CRPN, mean", "ACRPN, mean", "TRPO, mean", "CRPN, final",
         "TRPO, final", "CRPN's CPU time / TRPO's"]
    ]  # fmt: skip
    for task in found.tasks:
        seeds = str(len(found.values("CRPN", task, "mean_return")))
        means = _cells(found, ("CRPN", "ACRPN", "TRPO"), task, "mean_return")
        finals = _cells(found, ("CRPN", "TRPO"), task, "final_return")
        cost = tables.mean_cell(found.paired_ratios("CRPN", task, "cpu_seconds"), digits=2)
        rows.append([task, seeds, *means, *finals, cost])
    return _markdown(rows)


def headline() -> str:
    """Mean returns over training at equal settings; while none are measured, of the entries."""
    found = equal_runs()
    if found.empty:
        note = "Mean return over training, each algorithm with its published hyperparameters."
        return f"{note}\n\n{_entries()}"
    note = (
        "Mean return over training. All arms have CRPN's hyperparameters: environments, timesteps "
        "of an update, γ, λ, network, first noise, KL target and critic work."
    )
    rows = [["environment", "seeds", *EQUAL_ARMS]]
    for env, runs in found.groupby("env", sort=False):
        returns = [runs[runs.arm == arm].mean_return.to_numpy(float) for arm in EQUAL_ARMS]
        rows.append([str(env), str(len(returns[0])), *map(tables.mean_cell, returns)])
    return f"{note}\n\n{_markdown(rows)}"


def equal_runs() -> pd.DataFrame:
    """Return the runs of the equal-settings arms, of the seeds that all arms of a task have."""
    columns = [*store.KEYS, "hyperparameters", "mean_return"]
    published = _results(store.RESULTS.name, "TRPO").runs[columns]
    own = store.read_runs(LEARNING / "equal")[columns]
    found = []
    for env, budget in BUDGETS.items():
        runs = pd.concat([published, own], ignore_index=True) if len(own) else published
        runs = runs[(runs.env == env) & (runs.timesteps == budget)]
        arms = {arm: _arm(runs, *choice) for arm, choice in EQUAL_ARMS.items()}
        seeds = set.intersection(*(set(rows.seed) for rows in arms.values()))
        if len(seeds) >= MIN_SEEDS:
            found += [r[r.seed.isin(seeds)].assign(arm=arm) for arm, r in arms.items()]
    return pd.concat(found) if found else pd.DataFrame(columns=[*columns, "arm"])


def _arm(runs: pd.DataFrame, algo: str, setting: str) -> pd.DataFrame:
    rows = runs[runs.algo == algo]
    own = rows[rows.setting == setting]
    if own.empty:  # the entry has the setting already: the same run
        own = rows[(rows.setting == "") & rows.hyperparameters.str.contains(setting, regex=False)]
    return own.drop_duplicates("seed", keep="last").sort_values("seed")


def _entries() -> str:
    found = _results(store.RESULTS.name, "TRPO")
    learners = ("CRPN", "ACRPN", "TRPO")
    rows = [["environment", "seeds", *learners]]
    for task in found.tasks:
        seeds = str(len(found.values("CRPN", task, "mean_return")))
        rows.append([task, seeds, *_cells(found, learners, task, "mean_return")])
    return _markdown(rows)


def learners() -> str:
    """Mean return over training of every learner, on the environments that most of them ran on."""
    found = _results(store.RESULTS.name, "TRPO")
    tasks = found.tasks[:7]
    rows = [["mean return over training", *tasks]]
    for label in found.learners:
        rows.append([label, *(_cells(found, (label,), task, "mean_return")[0] for task in tasks)])
    return _markdown(rows)


def ablation() -> str:
    """One default changed at a time: interquartile means of normalised scores."""
    found = _results("ablation", "CRPN (defaults)")
    tasks = found.comparable_tasks(found.learners, "mean_return")
    scores = found.scores(found.learners, tasks, "mean_return")
    rows = [["changed", "IQM", *(task.split(" (")[0] for task in tasks)]]
    for label in found.learners:
        mean = tables._cell(stratified_bootstrap(scores[label], interquartile_mean))
        cells = (_cells(found, (label,), task, "mean_return")[0] for task in tasks)
        changed = re.sub(r"^CRPN \(defaults,?(.*)\)$", r"`\1`", label).replace(",", ", ")
        rows.append([changed if label != found.baseline else "nothing", mean, *cells])
    return _markdown(rows)


def _cells(found: Comparison, labels: Sequence[str], task: str, column: str) -> list[str]:
    return [tables.mean_cell(found.values(label, task, column)) for label in labels]


def _markdown(rows: list[list[str]]) -> str:
    header, *body = rows
    lines = [header, ["---"] * len(header), *body]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


TABLES: dict[str, Callable[[], str]] = {
    "ablation": ablation,
    "headline": headline,
    "learners": learners,
    "published": published,
}

if __name__ == "__main__":
    main()
