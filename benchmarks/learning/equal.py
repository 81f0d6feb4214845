"""CRPN, ACRPN, CRPN without the Hessian, and TRPO, all with the settings of CRPN's entries.

    python -m benchmarks.learning.equal       # run what is missing, short tasks first
    python -m benchmarks.learning.equal --envs CartPole-v1 --jobs 1
    python -m benchmarks.learning.equal --write docs/EQUAL_SETTINGS.md

Everything that the algorithms have in common is one and the same for an environment: environments,
steps of an update, γ, λ, network, first action noise, normalisation, KL target and critic work. A
run that the results of this command or of ``benchmarks.learning.rollouts`` hold already is not
repeated. Those of ``benchmarks.learning`` do not count: some are of earlier code.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.common.markdown import markdown
from benchmarks.common.pool import run_all
from benchmarks.learning import rollouts, store
from benchmarks.learning.comparison import Comparison, compare
from benchmarks.learning.run import Run, execute, make_run
from benchmarks.learning.settings import BUDGETS, RANDOM, TRPO_EQUAL
from benchmarks.learning.statistics import interquartile_mean, mean_score
from benchmarks.learning.tables import aggregate_table, task_table

RESULTS = Path(__file__).parent / "equal"
FOLDERS = (rollouts.RESULTS, RESULTS)

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
    parser.add_argument("--write", type=Path, metavar="FILE", help="run nothing, write the report")
    args = parser.parse_args()
    folders = (rollouts.RESULTS, args.results)
    if args.write is not None:
        args.write.parent.mkdir(parents=True, exist_ok=True)
        args.write.write_text(report(load(folders, args.timesteps)))
        return
    done = [store.read_runs(folder) for folder in folders]
    wanted = list(wanted_runs(args.envs, args.timesteps))
    missing = [run for run in wanted if not any(store.matches(run, rows).any() for rows in done)]
    print(f"{len(wanted) - len(missing)} of {len(wanted)} runs are done: {args.results}")
    keep = partial(store.append, args.results)
    if missing and run_all(execute, missing, keep, n_processes=args.jobs):
        sys.exit(1)


def wanted_runs(envs: Sequence[str], timesteps: int | None = None) -> Iterator[Run]:
    """Yield the runs stage by stage, seeds outermost: what is there so far is balanced."""
    for env, seed in _cases():
        if env in envs:
            arms = _arms(env, seed, timesteps)
            # an entry may have an arm's override already: the same run
            yield from {(run.algo, run.hyperparameters): run for run in reversed(arms)}.values()


def _cases() -> Iterator[tuple[str, int]]:
    for stage, n_seeds in STAGES:
        for seed, env in itertools.product(range(n_seeds), stage):
            yield env, seed


def _arms(env: str, seed: int, timesteps: int | None) -> list[Run]:
    return [make_run(algo, env, seed, given, timesteps=timesteps) for algo, given in ARMS]


def load(
    folders: Sequence[Path] = FOLDERS,
    timesteps: int | None = None,
    random: Path = store.RESULTS,
) -> Comparison:
    """Return the runs of these arms, for the seeds that all arms have, and the random policy's.

    Parameters
    ----------
    folders
        Results with the arms' runs; of a run in several folders the last counts.
    timesteps
        Of a run; by default the benchmark's budget.
    random
        Results with the random policy's runs.
    """
    runs = _joined([store.read_runs(folder) for folder in folders])
    curves = _joined([store.read_curves(folder) for folder in folders])
    found = []
    for env, seed in _cases():
        arms = [(run, store.matches(run, runs)) for run in _arms(env, seed, timesteps)]
        if all(is_run.any() for _, is_run in arms):
            found += [runs[is_run].tail(1).assign(setting=run.setting) for run, is_run in arms]
    envs = {rows.env.iloc[0] for rows in found}
    zeros = store.read_runs(random)
    zeros = zeros[(zeros.algo == RANDOM) & zeros.env.isin(envs)]
    return compare(pd.concat([*found, zeros], ignore_index=True), curves, TRPO_EQUAL)


def _joined(frames: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Return the rows of all; columns of frames without rows have no type."""
    found = [frame for frame in frames if not frame.empty]
    return pd.concat(found or frames[:1], ignore_index=True)


REPORT = """# Equal settings

CRPN, ACRPN, CRPN without the Hessian, and TRPO, all with the settings of CRPN's entry for the
environment (`zoo_configs/crpn.yml`): number of environments, `n_steps`, γ, λ, network, first action
noise, normalisation, `target_kl`, and the critic's learning rate, minibatches and passes over the
rollout. What the entry leaves out is CRPN's default for all of them. TRPO's conjugate gradients and
line search are sb3-contrib's. An update of CRPN has whole episodes, and so may have more steps than
`n_steps`; where all episodes last 1,000 steps, TRPO's updates have as many. Where the entry has no
Hessian (Walker2d-v5), CRPN is the arm without it.

Seeds are those that all arms have. Some settings of the entries were tried on seeds 0 to 3 over a
part of the budget ([which](benchmarks.md)), the others on seeds from 10 on; all were chosen for
CRPN as it is. {progress}

## Aggregate

{aggregate}

## Each environment

{tasks}

## Timesteps of an update

{updates}
"""


def report(comparison: Comparison) -> str:
    """Return the report's text."""
    means = {"IQM": interquartile_mean, "mean": mean_score}
    learners = comparison.runs[comparison.runs.algo != RANDOM]
    n_wanted = len(ARMS) * len(list(_cases()))
    return REPORT.format(
        progress=f"{len(learners)} of {n_wanted} runs are there; one seed alone has no interval, "
        "and says little.",
        aggregate=aggregate_table(comparison, comparison.learners, means),
        tasks=task_table(comparison),
        updates=updates_table(comparison),
    )


def updates_table(comparison: Comparison) -> str:
    """Return how many timesteps the updates had; runs that counted none have no number."""
    labels = comparison.learners
    body = []
    for task in comparison.tasks:
        found = [
            comparison.values(label, task, "steps") / comparison.values(label, task, "updates")
            for label in labels
        ]
        body.append([task, *("-" if np.isnan(v).all() else f"{np.nanmean(v):,.0f}" for v in found)])
    return markdown(["environment", *labels], body)


if __name__ == "__main__":
    main()
