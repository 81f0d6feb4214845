"""Seconds until a level is reached: CRPN, TRPO and PPO, each with its published entry.

    python -m benchmarks.wallclock --envs CartPole-v1 Pendulum-v1 --n-envs 1 8
    python -m benchmarks.wallclock --table

A run is at the level when the mean return of its latest training episodes is: no evaluation adds
to the time, and all learners are asked the same. It is given its entry's own number of steps. The
numbers of environments are the entry's and those asked for. Where CRPN has an entry for so many
environments (``zoo_configs/crpn_16_envs.yml``), that is taken; else an update keeps the entry's
number of steps, as far as whole episodes allow. Runs take turns in one process, and those that the
CSV holds are not repeated.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks.common.intervals import interval, ratio_of_medians
from benchmarks.common.markdown import estimate, markdown
from benchmarks.common.pool import run_all
from benchmarks.common.table import Table
from benchmarks.learning.run import Run, make_run, set_up, versions
from benchmarks.learning.settings import changes_for, resolve, update_timesteps

RESULTS = Path(__file__).with_suffix(".csv")
KEYS = ("env", "arm", "n_envs", "seed")
N_ENVS = (1, 8, 16, 64)


class Level(NamedTuple):
    """A mean return, and its number of episodes."""

    mean_return: float
    episodes: int = 100


LEVELS = {
    "CartPole-v1": Level(475.0),
    "Pendulum-v1": Level(-200.0),
    "Acrobot-v1": Level(-100.0),
    "HalfCheetah-v5": Level(2000.0, 10),  # of 1,000 steps each
}
OURS = "CRPN"
ARMS = (OURS, "TRPO", "PPO")


class Job(NamedTuple):
    """A run and the level that ends it."""

    arm: str
    n_envs: int
    run: Run
    level: Level

    @property
    def key(self) -> dict[str, Any]:
        """The columns that tell runs apart."""
        return {"env": self.run.env, "arm": self.arm, "n_envs": self.n_envs, "seed": self.run.seed}


def jobs(
    envs: Sequence[str], arms: Sequence[str], n_envs: Sequence[int], seeds: int
) -> Iterator[Job]:
    """Yield the runs, seeds outermost and learners innermost, so that arms take turns."""
    for seed in range(seeds):
        for env in envs:
            for number, arm in itertools.product((None, *n_envs), arms):
                yield make_job(arm, env, number, seed)


def make_job(arm: str, env: str, n_envs: int | None, seed: int) -> Job:
    """Return a run of the arm's entry in so many environments; ``None``: the entry's own."""
    entry = resolve(arm, env, {})[1]
    published = entry.get("n_envs", 1)
    overrides: dict[str, Any] = {}
    if n_envs is not None and n_envs != published:
        n_steps = max(1, update_timesteps(arm, entry) // n_envs)
        overrides = {"n_envs": n_envs, "n_steps": n_steps}
        if arm == OURS:
            overrides = changes_for(env, n_envs) or overrides
    run = make_run(arm, env, seed, overrides, timesteps=int(entry["n_timesteps"]))
    return Job(arm, n_envs or published, run, LEVELS[env])


def execute(job: Job) -> dict[str, Any]:
    """Train until the level is reached or the entry's steps are over."""
    with tempfile.TemporaryDirectory() as folder:
        _, model = set_up(job.run, Path(folder))
        until = UntilLevel(job.level)
        model.learn(job.run.timesteps, callback=until)
        model.get_env().close()
    return {
        "reached": int(until.reached),
        "wall_seconds": until.wall,
        "cpu_seconds": until.cpu,
        "steps": model.num_timesteps,
        "entry": job.run.entry,
        "setting": job.run.setting,
        "versions": versions(),
    }


class UntilLevel(BaseCallback):
    """Stops training at a level.

    Attributes
    ----------
    reached
        Whether the mean return of the latest training episodes was at the level.
    wall, cpu
        Seconds from the start of training until then, or until its end.
    """

    def __init__(self, level: Level) -> None:
        super().__init__()
        self.reached, self._level = False, level
        self._returns: deque[float] = deque(maxlen=level.episodes)

    def _on_training_start(self) -> None:
        self._start = time.perf_counter(), time.process_time()

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:  # raw rewards: VecNormalize is outside the monitor
                self._returns.append(info["episode"]["r"])
        is_full = len(self._returns) == self._level.episodes
        self.reached = is_full and float(np.mean(self._returns)) >= self._level.mean_return
        return not self.reached

    def _on_training_end(self) -> None:
        self.wall = time.perf_counter() - self._start[0]
        self.cpu = time.process_time() - self._start[1]


def tables(rows: pd.DataFrame) -> Iterator[str]:
    """Yield the times of all arms, and CRPN's best in the best peer's."""
    body = []
    for (env, arm, n_envs), runs in rows.groupby(["env", "arm", "n_envs"], sort=False):
        level = LEVELS[str(env)]
        reached = f"{runs.reached.sum()} of {len(runs)}"
        cells = [_median(runs, column) for column in ("wall_seconds", "cpu_seconds", "steps")]
        body.append([f"{env}: {level.mean_return:g}", arm, n_envs, reached, *cells])
    yield markdown(["task", "learner", "environments", "reached", "wall, s", "CPU, s", "steps"],
                   sorted(body, key=lambda line: (line[0], line[1], line[2])))  # fmt: skip
    yield markdown(["task", "CRPN's best", "the best peer", "wall / peer's", "CPU / peer's"],
                   _best_lines(rows))  # fmt: skip


def _median(runs: pd.DataFrame, column: str) -> str:
    """Return the median over seeds; where not all reached the level, it is a lower bound."""
    values = runs[column].astype(float).where(runs.reached == 1, np.inf)
    if not np.isfinite(values).all():
        return f"> {runs[column].median():,.0f}"
    spec = ",.0f" if column == "steps" else None
    return estimate(interval(values, statistic=np.median), spec)


def _best_lines(rows: pd.DataFrame) -> Iterator[list[str]]:
    """Yield a line a task: the fastest, by median wall time, that reach the level on all seeds."""
    for env, of_env in rows.groupby("env", sort=False):
        n_seeds = of_env.groupby(["arm", "n_envs"]).size().max()
        arms = {
            key: runs
            for key, runs in of_env.groupby(["arm", "n_envs"])
            if runs.reached.all() and len(runs) == n_seeds > 1
        }
        ours, peers = (
            [key for key in arms if (key[0] == OURS) == is_ours] for is_ours in (True, False)
        )
        if not ours or not peers:
            continue
        mine, theirs = (
            min(keys, key=lambda key: arms[key].wall_seconds.median()) for keys in (ours, peers)
        )
        ratios = [
            estimate(interval(arms[mine][column], arms[theirs][column], statistic=ratio_of_medians))
            for column in ("wall_seconds", "cpu_seconds")
        ]
        yield [str(env), *(f"{arm}, {n_envs}" for arm, n_envs in (mine, theirs)), *ratios]


def main() -> None:
    """Run what is missing, print the tables."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.wallclock",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--envs", nargs="+", default=list(LEVELS), choices=list(LEVELS))
    parser.add_argument("--arms", nargs="+", default=ARMS, choices=ARMS, metavar="ARM",
                        help=f"default: {' '.join(ARMS)}")  # fmt: skip
    parser.add_argument("--n-envs", type=int, nargs="*", default=N_ENVS, metavar="N")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--table", action="store_true", help="run nothing, print the tables")
    args = parser.parse_args()
    table = Table(args.results, KEYS)
    if not args.table:
        wanted = {tuple(job.key.values()): job for job in
                  jobs(args.envs, args.arms, args.n_envs, args.seeds)}  # fmt: skip
        missing = [wanted[tuple(key.values())] for key in
                   table.missing([job.key for job in wanted.values()])]  # fmt: skip
        print(f"{len(wanted) - len(missing)} of {len(wanted)} runs are done: {args.results}")
        keep = partial(_keep, table)
        if missing and run_all(execute, missing, keep, n_processes=1):
            sys.exit(1)
    print("\n\n".join(tables(table.read())))


def _keep(table: Table, job: Job, row: dict[str, Any]) -> None:
    table.append([job.key | row])


if __name__ == "__main__":
    main()
