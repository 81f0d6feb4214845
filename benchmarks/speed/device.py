"""Products, updates and certificates on a GPU, in the CPU's time."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch

from benchmarks.speed.problems import collect, noise_model
from benchmarks.speed.products import product_tasks
from benchmarks.speed.timing import Row, Task, compare
from benchmarks.speed.updates import update_task
from sb3_crpn import CRPN
from sb3_crpn.sosp import certify_sosp

SHAPE = "HalfCheetah-v5"
DEVICES = {"CPU": "cpu", "GPU": "cuda"}


def measure(
    repeats: int = 10,
    widths: Sequence[int] = (64, 256, 1024),
    n_steps: int = 4_000,
    n_episodes: int = 4,
) -> list[Row]:
    """Compare both devices at several hidden widths, or say why that was not possible.

    The wall clock is the one to read: a GPU works while the process waits. The CPU computes in one
    thread, as everywhere in this package.
    """
    if not torch.cuda.is_available():
        return [{"skipped": "torch.cuda.is_available() is False: there is no GPU to compare with"}]
    rows = []
    for width in widths:
        models = {name: _model(device, width, n_steps) for name, device in DEVICES.items()}
        builders: dict[str, Callable[[CRPN], Task]] = {
            "Hessian product": _product,
            "update": _update,
            "certificate": lambda model: _certificate(model, n_episodes),
        }
        for name, build in builders.items():
            tasks = {device: synchronised(build(model)) for device, model in models.items()}
            case = {"task": name, "width": width, "d": len(models["CPU"].actor), "T": n_steps}
            rows.append(compare(case, tasks, "CPU", repeats))
    return rows


def _model(device: str, width: int, n_steps: int) -> CRPN:
    arguments: dict[str, Any] = {"device": device, "width": width}
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


def _certificate(model: CRPN, n_episodes: int) -> Task:
    def run() -> None:
        certify_sosp(model, n_episodes, epsilon=1.0, seed=0)

    return Task(run)


def synchronised(task: Task) -> Task:
    """Return the task with the GPU's queue empty at both ends."""

    def run() -> float | None:
        torch.cuda.synchronize()
        work = task.run()
        torch.cuda.synchronize()
        return work

    return Task(run, task.prepare)
