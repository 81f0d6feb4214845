"""Tables and figures from the CSV files alone.

python -m benchmarks.learning.report                 # print the tables
python -m benchmarks.learning.report --write docs    # BENCHMARK.md and two pictures
"""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks.learning import comparison, figures, store, tables

CURVE_ENVS = ["CartPole-v1", "Pendulum-v1", "LunarLander-v3", "HalfCheetah-v5"]


def main() -> None:
    """Print or write the report."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.learning.report",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--results", type=Path, default=store.RESULTS, help="folder of the CSVs")
    parser.add_argument("--baseline", default="TRPO", help="what the others are compared with")
    parser.add_argument("--write", type=Path, metavar="FOLDER", help="write files, print nothing")
    parser.add_argument("--curve-algos", nargs="+", default=["CRPN", "ACRPN", "TRPO", "PPO"])
    parser.add_argument("--curve-envs", nargs="+", default=CURVE_ENVS)
    args = parser.parse_args()
    found = comparison.load(args.results, args.baseline)
    text = tables.report(found)
    if args.write is None:
        print(text)
        return
    args.write.mkdir(parents=True, exist_ok=True)
    (args.write / "BENCHMARK.md").write_text(text)
    curves = args.write / "learning_curves.png"
    figures.save_learning_curves(found, args.curve_envs, args.curve_algos, curves)
    figures.save_aggregate(found, args.write / "aggregate.png")


if __name__ == "__main__":
    main()
