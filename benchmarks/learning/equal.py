"""CRPN, ACRPN, CRPN without the Hessian, and TRPO, all with the settings of CRPN's entries.

    python -m benchmarks.learning.equal       # run what is missing, short tasks first
    python -m benchmarks.learning.equal --envs CartPole-v1 --jobs 1

Everything that the algorithms have in common is one and the same for an environment: environments,
steps of an update, γ, λ, network, first action noise, normalisation, KL target and critic work.
Seeds chose nothing: entries were tuned on others. A run that the benchmark's results or the results
of this command hold already is not repeated.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.common.pool import run_all
from benchmarks.learning import store
from benchmarks.learning.run import Run, execute, make_run
from benchmarks.learning.settings import BUDGETS, TRPO_EQUAL

RESULTS = Path(__file__).parent / "equal"

# Algorithm and overrides of its entry; ACRPN's entries are CRPN's
ARMS: tuple[tuple[str, dict[str, Any]], ...] = (
    (TRPO_EQUAL, {}),
    ("CRPN", {}),
    ("CRPN", {"hessian_shrinkage": 0.0}),
    ("ACRPN", {}),
)
# Environments in the order in which they run, and their seeds
STAGES: tuple[tuple[tuple[str, ...], int], ...] = (
    (
        (
            "CartPole-v1",
            "Acrobot-v1",
            "Pendulum-v1",
            "MountainCar-v0",
            "MountainCarContinuous-v0",
        ),
        10,
    ),
    (("LunarLander-v3", "LunarLanderContinuous-v3"), 5),
    (
        (
            "HalfCheetah-v5",
            "Hopper-v5",
            "Walker2d-v5",
            "Swimmer-v5",
            "Reacher-v5",
            "InvertedPendulum-v5",
        ),
        5,
    ),
    (("InvertedDoublePendulum-v5", "Ant-v5", "FetchReachDense-v4"), 5),
)


def main() -> None:
    """Run what is missing."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.learning.equal",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--envs", nargs="+", default=list(BUDGETS), choices=list(BUDGETS),
                        metavar="ENV", help=f"default: {' '.join(BUDGETS)}")  # fmt: skip
    parser.add_argument("--timesteps", type=int, help="default: the benchmark's budget")
    parser.add_argument("--jobs", type=int, default=2, help="parallel processes")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the CSVs")
    args = parser.parse_args()
    done = [store.read_runs(folder) for folder in (store.RESULTS, args.results)]
    wanted = list(wanted_runs(args.envs, args.timesteps))
    missing = [run for run in wanted if not any(store.is_done(run, rows) for rows in done)]
    print(f"{len(wanted) - len(missing)} of {len(wanted)} runs are done: {args.results}")
    keep = partial(store.append, args.results)
    if missing and run_all(execute, missing, keep, n_processes=args.jobs):
        sys.exit(1)


def wanted_runs(envs: Sequence[str], timesteps: int | None = None) -> Iterator[Run]:
    """Yield the runs stage by stage, seeds outermost: what is there so far is balanced."""
    for stage, n_seeds in STAGES:
        for seed, env in itertools.product(range(n_seeds), stage):
            if env in envs:
                runs = [make_run(algo, env, seed, o, timesteps=timesteps) for algo, o in ARMS]
                # an entry may have an arm's override already: the same run
                yield from {(run.algo, run.hyperparameters): run for run in reversed(runs)}.values()


if __name__ == "__main__":
    main()
