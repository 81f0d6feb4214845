"""Markdown tables of the measurements."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from benchmarks.common.markdown import estimate, markdown, number
from benchmarks.common.table import Row
from benchmarks.speed.timing import CLOCKS

# Keys of a comparison's row besides its case
_RESULTS = ("unit", "repeats", "ms", "ratio")

TITLES = {
    "products": "Products, in gradients",
    "updates": "Updates, in TRPO's",
    "collection": "Collection, per simulated step, in SB3's",
    "stepping": "Simulation, per step of an environment, in DummyVecEnv's",
    "many": "Many environments, per timestep, in TRPO's",
    "training": "Training, per timestep, in TRPO's",
    "solves": "Solves of random cubic models",
    "scaling": "Cost against T and d",
    "memory": "Peak memory above what is there before, MiB",
    "device": "GPU against CPU",
}


def report(results: dict[str, list[Row]]) -> str:
    """Return the tables of all stored parts."""
    return "\n\n".join(part_report(part, results[part]) for part in TITLES if part in results)


def part_report(part: str, results: list[Row]) -> str:
    """Return title, machine and tables of one part, from its circumstances and its rows."""
    circumstances, *rows = results
    machine = ", ".join(f"{value}" for value in circumstances["machine"].values())
    return "\n\n".join([f"## {TITLES[part]}", f"{machine}; {circumstances['seconds']:.0f} s.",
                        *_tables(part, rows)])  # fmt: skip


def _tables(part: str, rows: list[Row]) -> Iterable[str]:
    if "skipped" in rows[0]:
        yield f"Skipped: {rows[0]['skipped']}."
    elif part == "scaling":
        yield from (_scaling(row) for row in rows)
    elif part == "memory":
        yield _memory(rows)
    elif part == "solves":
        yield _comparisons(rows[:-1])
        yield _large_solves(rows[-1])
    else:
        yield _comparisons(rows)


def _comparisons(rows: list[Row]) -> str:
    """One line a comparison and clock: the case, the unit's ms, and the ratios to it."""
    case = [key for key in rows[0] if key not in _RESULTS]
    unit, names = rows[0]["unit"], list(rows[0]["ratio"])
    head = [*case, "clock", f"{unit}, ms", *(f"{name} / {unit}" for name in names)]
    body = [
        [
            *(row[key] for key in case),
            clock,
            number(row["ms"][unit][clock][0]),
            *(_estimate(row["ratio"][name][clock]) for name in names),
        ]
        for row in rows
        for clock in CLOCKS
    ]
    return markdown(head, body)


def _scaling(row: Row) -> str:
    """One line a size, with CPU times; the last lines hold the fitted slopes."""
    tasks = {name: clocks["cpu"] for name, clocks in row["tasks"].items()}
    body: list[list[Any]] = [
        [
            f"{size}{', cut' if row['cut'][i] else ''}",
            *(number(task["ms"][i][0]) for task in tasks.values()),
        ]
        for i, size in enumerate(row["sizes"])
    ]
    labels = {"slope": "slope", "last slope": "slope of the last two"}
    body += [
        [label, *(_estimate(task[key]) for task in tasks.values())] for key, label in labels.items()
    ]
    return markdown([row["over"], *(f"{name}, CPU ms" for name in tasks)], body)


def _large_solves(row: Row) -> str:
    lines = zip(row["sizes"], row["products"], row["certified"], row["ms"], strict=True)
    body: list[list[Any]] = [[d, n, ok, number(ms[0])] for d, n, ok, ms in lines]
    body.append(["slope", "", "", _estimate(row["slope"])])
    return markdown(["d", "products", "certified", "krylov, CPU ms"], body)


def _memory(rows: list[Row]) -> str:
    """One line a problem, one column a task."""
    names = list(dict.fromkeys(row["task"] for row in rows))
    lines: dict[tuple[Any, ...], dict[str, float]] = {}
    for row in rows:
        case = row["timesteps"], row["d"], row["max_batch_timesteps"] or "whole"
        lines.setdefault(case, {})[row["task"]] = row["growth"]
    body = [
        [*case, *(f"{growth[name]:.0f}" if name in growth else "" for name in names)]
        for case, growth in lines.items()
    ]
    return markdown(["T", "d", "batch", *names], body)


def _estimate(found: Sequence[float]) -> str:
    return estimate(found, ".2f")
