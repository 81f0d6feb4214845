"""Cost of one Hessian product against the timesteps T and the parameters d."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from benchmarks.common.table import Row
from benchmarks.speed.problems import collect, noise_model, width_for
from benchmarks.speed.products import product_tasks
from benchmarks.speed.timing import CLOCKS, interleaved, median, slope
from sb3_crpn import CRPN

SHAPE = "HalfCheetah-v5"
# Larger batches are split, since their graphs would not fit into memory
MAX_BATCH_TIMESTEPS = 50_000

TIMESTEPS = (1_000, 10_000, 100_000, 1_000_000)
PARAMETERS = (100, 1_000, 10_000, 100_000, 1_000_000)


def measure(
    repeats: int = 10,
    timesteps: Sequence[int] = TIMESTEPS,
    parameters: Sequence[int] = PARAMETERS,
    n_steps: int = 1_000,
) -> list[Row]:
    """Follow gradient and products over T at 64×64, and over d at T = ``n_steps``."""
    over_t = {T: {"n_steps": T, **split(T)} for T in timesteps}
    over_d = {d: {"n_steps": n_steps, "width": width_for(d, SHAPE)} for d in parameters}
    return [_follow("T", over_t, repeats), _follow("d", over_d, repeats)]


def split(timesteps: int) -> dict[str, Any]:
    """Return the split of batches of ``n_steps`` steps."""
    too_long = timesteps > 2 * MAX_BATCH_TIMESTEPS
    return {"max_batch_timesteps": MAX_BATCH_TIMESTEPS} if too_long else {}


def _follow(over: str, problems: dict[int, dict[str, Any]], repeats: int) -> Row:
    """Time all sizes in turn, and fit slopes over all sizes and over the last two."""
    sizes, tasks = [], {}
    for nominal, arguments in problems.items():
        model = noise_model(CRPN, SHAPE, **arguments)
        sizes.append(len(model.actor) if over == "d" else nominal)
        for name, task in product_tasks(model, collect(model)).items():
            tasks[name, sizes[-1]] = task
    times = interleaved({f"{n} {s}": task for (n, s), task in tasks.items()}, repeats, warm_ups=1)
    quantities: Row = {}
    for name in dict.fromkeys(n for n, _ in tasks):
        quantities[name] = {}
        for clock in CLOCKS:
            seconds = [times[f"{name} {size}"][clock] for size in sizes]
            quantities[name][clock] = {
                "ms": [median([1e3 * s for s in turns]) for turns in seconds],
                "slope": slope(sizes, seconds),
                "last slope": slope(sizes[-2:], seconds[-2:]),
            }
    cut = [bool(arguments.get("max_batch_timesteps")) for arguments in problems.values()]
    return {"over": over, "sizes": sizes, "cut": cut, "repeats": repeats, "tasks": quantities}
