"""Measure the cost of second order as ratios within one run. Print tables.

    python -m benchmarks.speed                      # all parts
    python -m benchmarks.speed products updates     # these alone; the others' results stay
    python -m benchmarks.speed --table              # print, measure nothing

Every part replaces its own results in the CSV file when it is done.
"""

from __future__ import annotations

import argparse
import platform
import re
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from benchmarks.common.parts import Parts
from benchmarks.common.table import Row
from benchmarks.speed import (
    collection,
    device,
    many,
    memory,
    products,
    scaling,
    solves,
    stepping,
    training,
    updates,
)
from benchmarks.speed.tables import part_report, report
from benchmarks.speed.timing import one_thread

PARTS: dict[str, Callable[..., list[Row]]] = {
    "products": products.measure,
    "updates": updates.measure,
    "collection": collection.measure,
    "stepping": stepping.measure,
    "many": many.measure,
    "training": training.measure,
    "solves": solves.measure,
    "scaling": scaling.measure,
    "memory": memory.measure,
    "device": device.measure,
}
RESULTS = Path(__file__).with_name("speed.csv")


def main(arguments: list[str] | None = None) -> None:
    """Run the given parts, or print the stored results."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.speed",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}")
    parser.add_argument("--results", type=Path, default=RESULTS, metavar="FILE")
    parser.add_argument("--table", action="store_true", help="print the results' tables")
    parser.add_argument("--repeats", type=int, help="turns of each task; default: each part's own")
    args = parser.parse_args(arguments)
    if unknown := [part for part in args.parts if part not in PARTS]:
        parser.error(f"{', '.join(unknown)} is no part, must be of {', '.join(PARTS)}")
    if args.table:
        print(report(Parts(args.results).read()))
        return
    sizes = {} if args.repeats is None else {"repeats": args.repeats}
    for part in args.parts or PARTS:
        run_part(part, args.results, **sizes)


def run_part(part: str, file: Path, **sizes: Any) -> None:
    """Measure a part, replace its results in the file, and print them."""
    start = time.perf_counter()
    with one_thread():
        rows = PARTS[part](**sizes)
    circumstances = {"machine": machine(), "seconds": time.perf_counter() - start}
    results = Parts(file)
    results.replace(part, [circumstances, *rows])
    print(part_report(part, results.read()[part]), end="\n\n", flush=True)


def machine() -> dict[str, str]:
    """Return the machine and versions that the times depend on."""
    found = {"processor": _processor()}
    if torch.cuda.is_available():
        found["gpu"] = torch.cuda.get_device_name()
    found["python"] = f"Python {platform.python_version()}"
    packages = ("torch", "numpy", "stable-baselines3", "sb3-contrib")
    return found | {name: f"{name} {version(name)}" for name in packages}


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists() and (found := re.search(r"model name\s*: (.*)", info.read_text())):
        return found[1]
    return platform.processor() or platform.machine()


if __name__ == "__main__":
    main()
