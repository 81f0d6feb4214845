"""What several ranks gain and what they cost, and a cost model for more of them.

OMP_NUM_THREADS=1 torchrun --standalone --nproc-per-node 2 -m benchmarks.distributed
python -m benchmarks.distributed --table

One process and all ranks do the same work in turn, with as many environments in all; while rank 0
works alone the others wait. The first command writes ``benchmarks/distributed.json``, the second
prints it as the tables of docs/DISTRIBUTED.md.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any
from unittest import mock

import torch
import torch.distributed as dist
from stable_baselines3.common.env_util import make_vec_env

from sb3_crpn import CRPN
from sb3_crpn.distributed import all_max, init_from_env, local_mode, rank, world_size

RESULTS = Path(__file__).with_suffix(".json")
MODES = ("one process", "all ranks")
# Fisher and Hessian products in one timing
N_PRODUCTS = 5
# float64 numbers in the reductions that are timed, and how often each is
SIZES, REPEATS = (1, 1_000, 10_000, 100_000, 1_000_000), 50
RANKS = (2, 8, 64, 512)


def setting(mode: str) -> AbstractContextManager[None]:
    """Return the context in which there are the ranks of this mode."""
    return local_mode() if mode == "one process" else nullcontext()


def parts(model: CRPN, n_episodes: int) -> dict[str, Callable[[], object]]:
    """Return what is timed of a model that has learnt once; the last makes graphs stale."""
    estimate = model.estimate_curvature(n_episodes)
    vector = torch.ones(len(model.actor), dtype=torch.float64)

    def products() -> None:
        for _ in range(N_PRODUCTS):
            estimate.fisher @ vector
            estimate.hessian @ vector

    return {
        "collection": lambda: model._collect_evaluation_episodes(n_episodes, None),
        "products": products,
        "update": model.train,
    }


def timed(mode: str, work: Callable[[], object] | None) -> tuple[float, float]:
    """Return wall and CPU time of the slowest rank; ``None`` is no work."""
    dist.barrier()
    wall, cpu = time.perf_counter(), time.process_time()
    if work is not None:
        with setting(mode):
            work()
    elapsed = time.perf_counter() - wall, time.process_time() - cpu
    return all_max(elapsed[0]), all_max(elapsed[1])


def measure(env_id: str, n_envs: int, n_episodes: int, rounds: int) -> dict[str, Any]:
    """Measure on all ranks; times in seconds."""
    work: dict[str, dict[str, Callable[[], object]]] = {}
    for mode in MODES:
        with setting(mode):
            env = make_vec_env(env_id, n_envs // world_size())
            model = CRPN("MlpPolicy", env, n_episodes=n_episodes, seed=0, device="cpu")
            if rank() == 0 or mode == "all ranks":
                model.learn(1)
                work[mode] = parts(model, n_episodes)
    n_timesteps = model.num_timesteps
    times: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for part in work["all ranks"]:
        times[part] = {mode: [] for mode in MODES}
        for turn in range(rounds + 1):
            for mode in MODES:
                elapsed = timed(mode, work.get(mode, {}).get(part))
                if turn:  # the first round warms up
                    times[part][mode].append(elapsed)
    return {
        "env": env_id,
        "ranks": world_size(),
        "cores": len(os.sched_getaffinity(0)),
        "load average": os.getloadavg()[0],
        "parameters": len(model.actor),
        "episodes": n_episodes,
        "timesteps": n_timesteps,
        "batch size": model.batch_size,
        "minibatches": model.n_critic_updates * math.ceil(n_timesteps / model.batch_size),
        "times": times,
        "messages": messages(model),
        "reductions": reductions(),
    }


def messages(model: CRPN) -> list[int]:
    """Return the bytes of every message of a rollout and its update."""
    sizes: list[int] = []

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(tensor: torch.Tensor, *rest: Any) -> Any:
            sizes.append(tensor.numel() * tensor.element_size())
            return function(tensor, *rest)

        return call

    with (
        mock.patch.object(dist, "all_reduce", counted(dist.all_reduce)),
        mock.patch.object(dist, "broadcast", counted(dist.broadcast)),
    ):
        model.learn(1, reset_num_timesteps=False)
    return sizes


def reductions() -> dict[int, list[float]]:
    """Return the seconds of reductions, by their bytes."""
    seconds: dict[int, list[float]] = {8 * size: [] for size in SIZES}
    for _ in range(REPEATS):
        for size in SIZES:
            tensor = torch.ones(size, dtype=torch.float64)
            start = time.perf_counter()
            dist.all_reduce(tensor)
            seconds[8 * size].append(time.perf_counter() - start)
    return seconds


def tables(results: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of the tables."""
    n_ranks = results["ranks"]
    yield (
        f"{results['env']}, {results['episodes']} episodes of {results['timesteps']} timesteps in "
        f"all an update, d = {results['parameters']}, {results['cores']} cores, load average "
        f"{results['load average']:.1f}\n"
    )
    header = f"one process, s | {n_ranks} ranks, s | speed-up | CPU time / that of the busier rank"
    yield f"| | {header} |\n|---|---|---|---|---|"
    for part, modes in results["times"].items():
        one, many = (modes[mode] for mode in MODES)
        wall = [statistics.median(t for t, _ in each) for each in (one, many)]
        ratios = (_quartiles(one, many, clock) for clock in (0, 1))
        yield f"| {part} | {wall[0]:.3f} | {wall[1]:.3f} | {' | '.join(ratios)} |"
    critic = statistics.mode(results["messages"])
    n_critic, total = results["minibatches"], sum(results["messages"])
    n_others, others = len(results["messages"]) - n_critic, total - n_critic * critic
    yield "\n| messages of an update | number | bytes in all |\n|---|---|---|"
    yield f"| the critic's gradients | {n_critic} | {n_critic * critic:,} |"
    yield f"| all others | {n_others} | {others:,} |"
    yield from model_lines(results, n_critic, critic, n_others, others)


def _quartiles(one: list[list[float]], many: list[list[float]], clock: int) -> str:
    ratios = [a[clock] / b[clock] for a, b in zip(one, many, strict=True)]
    low, middle, high = statistics.quantiles(ratios, n=4)
    return f"{middle:.2f} [{low:.2f}, {high:.2f}]"


def model_lines(
    results: dict[str, Any], n_critic: int, critic: int, n_others: int, others: int
) -> Iterator[str]:
    """Yield what more ranks would do, each with the timesteps that one process had.

    A reduction by a ring of W ranks takes 2(W - 1) hops, each with 1/W of the bytes. What the
    measured ranks' update took beyond that and its share of the work is laid on the messages, each
    the same, whatever W: packing them, waking up, and minibatches too small to be efficient. Work
    and messages are taken at their fastest, when other processes disturbed them least.
    """
    fastest = {int(size): min(seconds) for size, seconds in results["reductions"].items()}
    small, large = min(fastest), max(fastest)
    hops = 2 * (results["ranks"] - 1)
    per_hop = fastest[small] / hops
    per_byte = (fastest[large] - fastest[small]) / (large - small) * results["ranks"] / hops

    def reducing(number: float, total_bytes: float, n_ranks: int) -> float:
        hops = 2 * (n_ranks - 1)
        return number * hops * per_hop + total_bytes * hops / n_ranks * per_byte

    one, many = (
        {part: min(t[0] for t in times[mode]) for part, times in results["times"].items()}
        for mode in MODES
    )
    number, total = n_others + n_critic, others + n_critic * critic
    explained = one["update"] / results["ranks"] + reducing(number, total, results["ranks"])
    per_message = max(0.0, many["update"] - explained) / number
    work = one["collection"] + one["update"]
    yield (
        f"\n{1e6 * per_message:.0f} µs a message and {1e6 * per_hop:.0f} µs a hop, "
        f"{1e-9 / per_byte:.1f} GB/s, {work:.2f} s of work an update\n\n"
        "| ranks | `batch_size` | messages, s | efficiency | timesteps/s | episodes/s |"
        "\n|---|---|---|---|---|---|"
    )
    for own in (results["batch size"], results["timesteps"]):  # a rank's part of a minibatch
        minibatches = n_critic * results["batch size"] / own
        for n_ranks in RANKS:
            number = n_others + minibatches
            waiting = number * per_message
            waiting += reducing(number, others + minibatches * critic, n_ranks)
            rate = n_ranks / (work + waiting)
            yield (
                f"| {n_ranks} | {n_ranks} · {own} | {waiting:.2f} "
                f"| {100 * work / (work + waiting):.0f} % | {rate * results['timesteps']:,.0f} "
                f"| {rate * results['episodes']:,.1f} |"
            )


def main() -> None:
    """Measure under torchrun, or print what was measured."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--n-envs", type=int, default=4, help="in all")
    parser.add_argument("--n-episodes", type=int, default=4, help="in all, an update")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--table", action="store_true", help="print the last measurement")
    arguments = parser.parse_args()
    if not arguments.table:
        torch.set_num_threads(1)
        init_from_env()
        if world_size() == 1:
            parser.error("start it with torchrun --nproc-per-node 2, or ask for the --table")
        results = measure(arguments.env, arguments.n_envs, arguments.n_episodes, arguments.rounds)
        if rank() > 0:
            return
        RESULTS.write_text(json.dumps(results, indent=1))
    print("\n".join(tables(json.loads(RESULTS.read_text()))))


if __name__ == "__main__":
    main()
