"""Products, updates and certificates on a GPU, relative to the CPU."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch

from benchmarks.common.table import Row
from benchmarks.speed.problems import collect, noise_model
from benchmarks.speed.products import product_tasks
from benchmarks.speed.timing import Task, compare
from benchmarks.speed.updates import update_task
from sb3_crpn import CRPN
from sb3_crpn.sosp import certify_sosp

SHAPE = "HalfCheetah-v5"
# Hidden width and timesteps of the batch
SIZES = ((64, 2_000), (64, 16_000), (256, 2_000), (1024, 2_000))


def measure(
    repeats: int = 4, sizes: Sequence[tuple[int, int]] = SIZES, episode: int = 500
) -> list[Row]:
    """Compare the GPU with one core and with all cores, or state why that is impossible.

    The wall clock is the one to read: a GPU works while the process waits.
    """
    if not torch.cuda.is_available():
        return [{"skipped": "torch.cuda.is_available() is False: there is no GPU to compare with"}]
    rows = []
    for width, n_steps in sizes:
        on_cpu, on_gpu = (_model(device, width, n_steps, episode) for device in ("cpu", "cuda"))
        builders: dict[str, Callable[[CRPN], Task]] = {
            "Hessian product": _product,
            "update": _update,
            "certificate": _certificate,
        }
        for name, build in builders.items():
            case = {"task": name, "width": width, "d": len(on_cpu.actor), "T": n_steps}
            alone = build(on_cpu)
            n_cores = os.cpu_count() or 1
            tasks = {
                "1 core": alone,
                f"{n_cores} cores": threaded(alone, n_cores),
                "GPU": synchronised(build(on_gpu)),
            }
            rows.append(compare(case, tasks, "1 core", repeats, warm_ups=1))
    return rows


def _model(device: str, width: int, n_steps: int, episode: int) -> CRPN:
    arguments: dict[str, Any] = {"device": device, "width": width, "episode": episode}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="You are trying to run .* on the GPU")
        return noise_model(CRPN, SHAPE, n_steps, **arguments)


def _product(model: CRPN) -> Task:
    return product_tasks(model, collect(model))["Hessian product"]


def _update(model: CRPN) -> Task:
    """Return the update from a rollout; the one before it has found α."""
    collect(model)
    model.train()
    collect(model)
    return update_task(model, critic=True)


def _certificate(model: CRPN) -> Task:
    """Return the certificate from as many timesteps as the update's, one episode an environment."""

    def run() -> None:
        certify_sosp(model, model.n_envs, epsilon=1.0, seed=0)

    return Task(run)


def threaded(task: Task, n_threads: int) -> Task:
    """Return the task with the given number of torch threads, and one thread after it."""

    def run() -> float | None:
        torch.set_num_threads(n_threads)
        try:
            return task.run()
        finally:
            torch.set_num_threads(1)

    return Task(run, task.prepare)


def synchronised(task: Task) -> Task:
    """Return the task with a synchronised GPU before and after it."""

    def run() -> float | None:
        torch.cuda.synchronize()
        work = task.run()
        torch.cuda.synchronize()
        return work

    return Task(run, task.prepare)
