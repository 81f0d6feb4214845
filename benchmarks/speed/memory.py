"""Peak memory of gradients, products and updates, each measured in a fresh process.

python -m benchmarks.speed.memory --task CRPN --timesteps 1000000 --max-batch-timesteps 50000
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from sb3_contrib import TRPO

from benchmarks.common.table import Row
from benchmarks.speed import scaling
from benchmarks.speed.problems import collect, noise, noise_model, width_for
from benchmarks.speed.products import product_tasks
from sb3_crpn import ACRPN, CRPN

PRODUCTS = ("gradient", "Hessian product", "Fisher product")
UPDATES = ("TRPO", "CRPN", "ACRPN")
EPISODE = 1000


def measure(
    repeats: int = 3,
    timesteps: Sequence[int] = scaling.TIMESTEPS,
    parameters: Sequence[int] = scaling.PARAMETERS,
    updates: Sequence[int] = (2_000, 50_000),
) -> list[Row]:
    """Measure products over T and over d, and updates; ``repeats`` processes each.

    A product's growth is above the batch, an update's above the model: the rollout is part of it.
    """
    rows = []
    for T in timesteps:
        rows += [_row(task, repeats, timesteps=T, **scaling.split(T)) for task in PRODUCTS]
    for d in parameters:
        width = width_for(d, scaling.SHAPE)
        rows += [_row(task, repeats, timesteps=1_000, width=width) for task in PRODUCTS]
    for T in updates:
        rows += [_row(task, repeats, timesteps=T) for task in UPDATES]
    return rows


def _row(task: str, repeats: int, **options: Any) -> Row:
    """Return the median growth over fresh processes, MiB."""
    found = [in_a_process(task, **options) for _ in range(repeats)]
    growths = sorted(row["peak"] - row["before"] for row in found)
    return {**found[0], "growth": growths[len(growths) // 2], "growths": growths}


def in_a_process(task: str, **options: Any) -> Row:
    """Run this module and return what it prints."""
    command = [sys.executable, "-m", __name__, "--task", task]
    command += [f"--{key.replace('_', '-')}={value}" for key, value in options.items()]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    root = Path(__file__).parents[2]
    done = subprocess.run(
        command, cwd=root, env=environment, stdout=subprocess.PIPE, text=True, check=True
    )
    return dict(json.loads(done.stdout))


def peak_memory() -> float:
    """Return the largest resident set of this process so far, in MiB.

    From Linux's ``VmHWM`` where there is one: ``ru_maxrss`` does not fall below what the process
    that started this one had.
    """
    status = Path("/proc/self/status")
    if status.exists() and (found := re.search(r"VmHWM:\s+(\d+) kB", status.read_text())):
        return int(found[1]) / 2**10
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def main() -> None:
    """Run one task and print the peak memory before and after it, in MiB."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="CRPN", choices=(*PRODUCTS, *UPDATES))
    parser.add_argument("--timesteps", type=int, default=1_000_000)
    parser.add_argument("--max-batch-timesteps", type=int)
    parser.add_argument("--krylov-dim", type=int)
    parser.add_argument("--width", type=int, default=64)
    options = vars(parser.parse_args())
    torch.set_num_threads(1)
    run, d = _update(**options) if options["task"] in UPDATES else _product(**options)
    before = peak_memory()
    run()
    print(json.dumps({**options, "d": d, "before": before, "peak": peak_memory()}))


def _product(
    task: str, timesteps: int, width: int, max_batch_timesteps: int | None, **_: Any
) -> tuple[Callable[[], object], int]:
    """Return the task, on episodes that are there already, and d.

    Without a critic no pass over the batch comes before the task, which would raise the peak that
    the task is compared with.
    """
    model = noise_model(
        CRPN,
        scaling.SHAPE,
        timesteps,
        width=width,
        max_batch_timesteps=max_batch_timesteps,
        baseline=False,
        gae_lambda=1.0,
        bootstrap_truncated=False,
        n_reused_rollouts=0,
    )
    return product_tasks(model, collect(model))[task].run, len(model.actor)


def _update(
    task: str, timesteps: int, width: int, **arguments: Any
) -> tuple[Callable[[], object], int]:
    """Return one rollout and its update, with one critic epoch, and d."""
    algorithm = {"CRPN": CRPN, "ACRPN": ACRPN}.get(task)
    if algorithm is not None:
        model = noise_model(
            algorithm, scaling.SHAPE, timesteps, width=width, n_critic_updates=1, **arguments
        )
        return lambda: model.learn(1), len(model.actor)
    if arguments["max_batch_timesteps"] is not None or arguments["krylov_dim"] is not None:
        raise ValueError("TRPO has neither max_batch_timesteps nor krylov_dim")
    length = min(EPISODE, timesteps // 2)
    peer = TRPO(
        "MlpPolicy",
        noise(scaling.SHAPE, timesteps // length),
        n_steps=length,
        batch_size=length,
        n_critic_updates=1,
        policy_kwargs={"net_arch": [width, width]},
        device="cpu",
    )
    d = sum(p.numel() for name, p in peer.policy.named_parameters() if "value" not in name)
    return lambda: peer.learn(1), d


if __name__ == "__main__":
    main()
