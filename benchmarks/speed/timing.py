"""Times of interleaved tasks, and their ratios.

pytest-benchmark and pyperf time one function after the other, so that a shared machine's drift
enters their ratios; here the calls are interleaved in random order and ratios formed turn by turn.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch

from benchmarks.common.intervals import interval
from benchmarks.common.table import Row

WARM_UPS = 2
CLOCKS: dict[str, Callable[[], float]] = {"cpu": time.process_time, "wall": time.perf_counter}

# seconds of each turn, by task and clock
Times: TypeAlias = dict[str, dict[str, list[float]]]


class Task(NamedTuple):
    """Something to time.

    ``run`` returns the amount of work that its time is divided by, or ``None`` for one unit;
    ``prepare`` is called before it and not timed.
    """

    run: Callable[[], float | None]
    prepare: Callable[[], object] = lambda: None


def interleaved(
    tasks: Mapping[str, Task], repeats: int, warm_ups: int = WARM_UPS, seed: int = 0
) -> Times:
    """Return each task's times, one a turn; in every turn each task runs once."""
    rng = np.random.default_rng(seed)
    times: Times = {name: {clock: [] for clock in CLOCKS} for name in tasks}
    with one_thread():
        for turn in range(-warm_ups, repeats):
            for name in rng.permutation(list(tasks)):
                tasks[name].prepare()
                starts = [clock() for clock in CLOCKS.values()]
                work = tasks[name].run()
                ends = [clock() for clock in CLOCKS.values()]
                for clock, start, end in zip(CLOCKS, starts, ends, strict=True):
                    if turn >= 0:
                        times[name][clock].append((end - start) / (work or 1.0))
    return times


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute in one thread inside the block."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def median(values: Sequence[float]) -> list[float]:
    """Return the sample median and the bounds of its interval."""
    return list(interval(values, statistic=np.median))


def compare(
    case: Row, tasks: Mapping[str, Task], unit: str, repeats: int, warm_ups: int = WARM_UPS
) -> Row:
    """Return ``case`` with the tasks' times in ms and, for all but ``unit``, in units of its."""
    times = interleaved(tasks, repeats, warm_ups)
    return {
        **case,
        "unit": unit,
        "repeats": repeats,
        "ms": {name: _by_clock(lambda c, n=name: 1e3 * _array(times, n, c)) for name in tasks},
        "ratio": {
            name: _by_clock(lambda c, n=name: _array(times, n, c) / _array(times, unit, c))
            for name in tasks
            if name != unit
        },
    }


def slope(sizes: Sequence[float], times: Sequence[Sequence[float]]) -> list[float]:
    """Return the slope of log time over log size, and its interval.

    Least squares over all sizes, once for every turn (``times`` is [sizes, turns]); then the
    median of the turns' slopes.
    """
    x = np.log(np.asarray(sizes, dtype=float))
    x -= x.mean()
    return median((x @ np.log(np.asarray(times, dtype=float))) / (x @ x))


def _array(times: Times, name: str, clock: str) -> np.ndarray[Any, Any]:
    # process_time ticks coarsely on some systems; a ratio needs a time above zero
    return np.maximum(times[name][clock], 1e-9)


def _by_clock(values: Callable[[str], Sequence[float]]) -> dict[str, list[float]]:
    return {clock: median(values(clock)) for clock in CLOCKS}
