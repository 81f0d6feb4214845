"""Train algorithms × environments × seeds in parallel processes; resume where it stopped.

    python -m benchmarks.learning --algos CRPN TRPO --envs CartPole-v1 Pendulum-v1 --seeds 10
    python -m benchmarks.learning --algos CRPN --defaults --set "" gamma=1 n_steps=1024,gamma=1
    python -m benchmarks.learning --algos CRPN --defaults @benchmarks/learning/ablation/settings.txt

A run that the results hold already is not repeated. Seeds come outermost and algorithms innermost,
so that what is there so far is balanced. ``Random`` measures the random policy; ``@FILE`` stands
for arguments, one a line.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from benchmarks.common.pool import run_all
from benchmarks.learning import store
from benchmarks.learning.run import Run, execute, make_run
from benchmarks.learning.settings import ALGORITHMS, BUDGETS, RANDOM, TRPO_EQUAL, parse_setting


def main() -> None:
    """Run what is missing."""
    args = _parse_arguments()
    done = store.read_runs(args.results)
    wanted = list(dict.fromkeys(_wanted_runs(args)))
    missing = [run for run in wanted if not store.is_done(run, done)]
    print(f"{len(wanted) - len(missing)} of {len(wanted)} runs are done: {args.results}")
    keep = partial(store.append, args.results)
    if missing and run_all(execute, missing, keep, n_processes=args.jobs):
        sys.exit(1)


def _parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.learning",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        fromfile_prefix_chars="@",
    )
    names = [*ALGORITHMS, RANDOM]
    usual = [name for name in names if name != TRPO_EQUAL]
    parser.add_argument("--algos", nargs="+", default=usual, choices=names, metavar="ALGO",
                        help=f"default: {' '.join(usual)}")  # fmt: skip
    parser.add_argument("--envs", nargs="+", default=list(BUDGETS), metavar="ENV",
                        help=f"default: {' '.join(BUDGETS)}")  # fmt: skip
    parser.add_argument("--seeds", type=int, default=3, help="seeds 0, …, SEEDS - 1")
    parser.add_argument("--first-seed", type=int, default=0, help="start from this one instead")
    parser.add_argument("--set", nargs="+", default=[""], metavar="KEY=VALUE,...",
                        dest="settings", help='override hyperparameters; "" for none')  # fmt: skip
    parser.add_argument("--defaults", action="store_true",
                        help="constructor's defaults in place of the YAML entries")  # fmt: skip
    parser.add_argument("--timesteps", type=int, help="default: the benchmark's budget")
    parser.add_argument("--jobs", type=int, default=2, help="parallel processes")
    parser.add_argument("--results", type=Path, default=store.RESULTS, help="folder of the CSVs")
    args = parser.parse_args()
    unknown = [env for env in args.envs if env not in BUDGETS]
    if unknown and args.timesteps is None:
        parser.error(f"no budget for {' '.join(unknown)}: give --timesteps")
    return args


def _wanted_runs(args: argparse.Namespace) -> Iterator[Run]:
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    for seed, env, setting, algo in itertools.product(seeds, args.envs, args.settings, args.algos):
        overrides = parse_setting(setting)
        yield make_run(algo, env, seed, overrides, timesteps=args.timesteps, defaults=args.defaults)


if __name__ == "__main__":
    main()
