"""CRPN with rollouts of whole episodes and of timesteps, at equal settings.

    python -m benchmarks.learning.rollouts --jobs 1   # run what is missing
    python -m benchmarks.learning.rollouts --table
    python -m benchmarks.learning.rollouts --table --results benchmarks/learning/many

Settings are those of CRPN's entries. With other numbers of environments an update keeps the entry's
timesteps, as far as whole episodes allow. Stages come in the order in which they decide a default;
within one, seeds come outermost. Runs that the results hold are not repeated.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from benchmarks.common.intervals import difference_of_means, interval
from benchmarks.common.markdown import estimate, markdown
from benchmarks.common.pool import run_all
from benchmarks.learning import store
from benchmarks.learning.run import Run, execute, make_run
from benchmarks.learning.settings import (
    BUDGETS,
    parse_setting,
    resolve,
    setting_label,
    update_timesteps,
)

RESULTS = Path(__file__).parent / "rollout"
ROLLOUTS = ("episodes", "timesteps")


class Stage(NamedTuple):
    """Environments, seeds 0, …, ``n_seeds`` - 1, numbers of environments and a budget.

    ``None`` stands for the entry's and the benchmark's.
    """

    envs: Sequence[str]
    n_seeds: int
    n_envs: Sequence[int | None] = (None,)
    timesteps: int | None = None


STAGES = (
    Stage(("CartPole-v1", "Pendulum-v1", "Acrobot-v1"), 5),
    Stage(("HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Ant-v5", "Humanoid-v5"), 5,
          timesteps=300_000),
    Stage(("LunarLander-v3",), 3),
    Stage(("CartPole-v1", "Pendulum-v1"), 3, n_envs=(1, 16, 64)),
    Stage(("HalfCheetah-v5", "Hopper-v5"), 2, n_envs=(16,), timesteps=150_000),
)  # fmt: skip


def main() -> None:
    """Run what is missing, print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.learning.rollouts",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--envs", nargs="+", metavar="ENV", help="default: all")
    parser.add_argument("--jobs", type=int, default=2, help="parallel processes")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the CSVs")
    parser.add_argument("--table", action="store_true", help="run nothing, print the table")
    args = parser.parse_args()
    if not args.table:
        done = store.read_runs(args.results)
        wanted = [run for run in wanted_runs() if not args.envs or run.env in args.envs]
        missing = [run for run in wanted if not store.is_done(run, done)]
        print(f"{len(wanted) - len(missing)} of {len(wanted)} runs are done: {args.results}")
        keep = partial(store.append, args.results)
        if missing and run_all(execute, missing, keep, n_processes=args.jobs):
            sys.exit(1)
    found = store.read_runs(args.results)
    print(f"{differences(found)}\n\n{table(found)}")


def wanted_runs() -> list[Run]:
    """Return the runs of all stages, each once."""
    return list(dict.fromkeys(run for stage in STAGES for run in _runs(stage)))


def _runs(stage: Stage) -> Iterator[Run]:
    for seed, env, n_envs in itertools.product(range(stage.n_seeds), stage.envs, stage.n_envs):
        size = {} if n_envs is None else _size(env, n_envs)
        for rollout in ROLLOUTS:
            overrides = size | ({} if rollout == "episodes" else {"rollout": rollout})
            timesteps = stage.timesteps or BUDGETS[env]
            yield make_run("CRPN", env, seed, overrides, timesteps=timesteps)


def _size(env: str, n_envs: int) -> dict[str, int]:
    """Return the number of environments, and ``n_steps`` that keep the entry's update."""
    timesteps = update_timesteps("CRPN", resolve("CRPN", env, {})[1])
    return {"n_envs": n_envs, "n_steps": max(1, round(timesteps / n_envs))}


def table(runs: pd.DataFrame) -> str:
    """Return means over seeds with 95 % intervals: one line an environment and setting."""
    head = ["environment", "timesteps", "environments", "rollout", "other changes", "seeds",
            "mean over training", "final", "episodes", "CPU s"]  # fmt: skip
    body = [
        [
            *key,
            len(group),
            estimate(interval(group["mean_return"]), ",.0f"),
            estimate(interval(group["final_return"]), ",.0f"),
            f"{group['episodes'].mean():.0f}",
            f"{group['cpu_seconds'].mean():.0f}",
        ]
        for key, group in runs.groupby(_keys(runs), sort=True)
    ]
    return markdown(head, body)


def differences(runs: pd.DataFrame) -> str:
    """Return the return of timesteps less that of episodes, where both have two seeds or more."""
    head = ["environment", "timesteps", "environments", "seeds", "mean over training", "final"]
    size, rollout = _keys(runs)[2:4]
    body = []
    for key, group in runs.groupby([runs["env"], runs["timesteps"], size], sort=True):
        arms = [group[rollout[group.index] == name] for name in reversed(ROLLOUTS)]
        n_seeds = min(len(arm) for arm in arms)
        if n_seeds < 2:
            continue
        found = (
            interval(*(arm[column] for arm in arms), statistic=difference_of_means)
            for column in ("mean_return", "final_return")
        )
        body.append([*key, n_seeds, *(estimate(each, "+,.0f") for each in found)])
    return markdown(head, body)


def _keys(runs: pd.DataFrame) -> list[pd.Series]:
    """Return environment, timesteps, number of environments, rollout and what else changes."""
    settings = runs["setting"].map(parse_setting)
    size = settings.map(lambda setting: setting.get("n_envs", "entry's"))
    rollout = settings.map(lambda setting: setting.get("rollout", "episodes"))
    others = settings.map(_other_changes)
    return [runs["env"], runs["timesteps"], size.rename("n_envs"), rollout.rename("rollout"),
            others.rename("others")]  # fmt: skip


def _other_changes(setting: dict[str, Any]) -> str:
    return setting_label({k: v for k, v in setting.items() if k not in ("n_envs", "rollout")})


if __name__ == "__main__":
    main()
