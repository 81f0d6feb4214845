"""The speed-up and the cost of several ranks, and a cost model for more ranks.

OMP_NUM_THREADS=1 torchrun --standalone --nproc-per-node 2 -m benchmarks.distributed
python -m benchmarks.distributed --table

One process and all ranks do the same work in turn, with as many environments in all; while rank 0
works alone the others wait. The first command writes ``benchmarks/distributed.csv``, the second
prints it as the tables of docs/DISTRIBUTED.md.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import torch
import torch.distributed as dist
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.common.intervals import Estimate
from benchmarks.common.markdown import estimate, markdown
from benchmarks.common.parts import Parts
from benchmarks.common.table import Row
from sb3_crpn import CRPN
from sb3_crpn.distributed import all_max, init_from_env, local_mode, rank, world_size

RESULTS = Parts(Path(__file__).with_suffix(".csv"))
MODES = ("one process", "all ranks")
# Fisher and Hessian products in one timing
N_PRODUCTS = 5
# Sizes of the timed reductions in float64 numbers, and their repetitions
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
        "collection": lambda: model.rollouts.evaluate(model, n_episodes, None),
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


def measure(env_id: str, n_envs: int, n_episodes: int, rounds: int) -> dict[str, list[Row]]:
    """Measure on all ranks; return the rows of each part, times in seconds."""
    work: dict[str, dict[str, Callable[[], object]]] = {}
    for mode in MODES:
        with setting(mode):
            env = make_vec_env(env_id, n_envs // world_size())
            model = CRPN("MlpPolicy", env, n_episodes=n_episodes, seed=0, device="cpu")
            if rank() == 0 or mode == "all ranks":
                model.learn(1)
                work[mode] = parts(model, n_episodes)
    n_timesteps = model.num_timesteps
    circumstances = {
        "env": env_id,
        "ranks": world_size(),
        "cores": len(os.sched_getaffinity(0)),
        "load average": os.getloadavg()[0],
        "parameters": len(model.actor),
        "episodes": n_episodes,
        "timesteps": n_timesteps,
        "batch size": model.batch_size,
        "minibatches": model.n_critic_updates * math.ceil(n_timesteps / model.batch_size),
    }
    return {
        "circumstances": [circumstances],
        "times": times(work, rounds),
        "messages": messages(model),
        "reductions": reductions(),
    }


def times(work: dict[str, dict[str, Callable[[], object]]], rounds: int) -> list[Row]:
    """Return each part's times in each mode, a number a round, the modes in turn."""
    rows = []
    for part in work["all ranks"]:
        found: dict[str, list[tuple[float, float]]] = {mode: [] for mode in MODES}
        for turn in range(rounds + 1):
            for mode in MODES:
                elapsed = timed(mode, work.get(mode, {}).get(part))
                if turn:  # the first round warms up
                    found[mode].append(elapsed)
        for mode, elapsed_times in found.items():
            wall, cpu = zip(*elapsed_times, strict=True)
            rows.append({"part": part, "mode": mode, "wall": list(wall), "cpu": list(cpu)})
    return rows


def messages(model: CRPN) -> list[Row]:
    """Return how many messages of each size a rollout and its update send."""
    sizes: Counter[int] = Counter()

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(tensor: torch.Tensor, *rest: Any) -> Any:
            sizes[tensor.numel() * tensor.element_size()] += 1
            return function(tensor, *rest)

        return call

    with (
        mock.patch.object(dist, "all_reduce", counted(dist.all_reduce)),
        mock.patch.object(dist, "broadcast", counted(dist.broadcast)),
    ):
        model.learn(1, reset_num_timesteps=False)
    return [{"bytes": size, "number": number} for size, number in sizes.items()]


def reductions() -> list[Row]:
    """Return the seconds of the fastest reduction of each size."""
    seconds: dict[int, list[float]] = {8 * size: [] for size in SIZES}
    for _ in range(REPEATS):
        for size in SIZES:
            tensor = torch.ones(size, dtype=torch.float64)
            start = time.perf_counter()
            dist.all_reduce(tensor)
            seconds[8 * size].append(time.perf_counter() - start)
    return [{"bytes": size, "seconds": min(found)} for size, found in seconds.items()]


def tables(results: dict[str, list[Row]]) -> Iterator[str]:
    """Yield the measurements and the cost model, a paragraph or a table each."""
    (case,) = results["circumstances"]
    yield (
        f"{case['env']}, {case['episodes']} episodes of {case['timesteps']} timesteps in all an "
        f"update, d = {case['parameters']}, {case['cores']} cores, load average "
        f"{case['load average']:.1f}"
    )
    yield _times_table(results["times"], case["ranks"])
    sizes = Counter({row["bytes"]: row["number"] for row in results["messages"]})
    ((critic, _),) = sizes.most_common(1)
    n_critic, n_others = case["minibatches"], sizes.total() - case["minibatches"]
    others = sum(size * number for size, number in sizes.items()) - n_critic * critic
    body = [
        ["the critic's gradients", n_critic, f"{n_critic * critic:,}"],
        ["all others", n_others, f"{others:,}"],
    ]
    yield markdown(["messages of an update", "number", "bytes in all"], body)
    yield from model_tables(results, n_critic, critic, n_others, others)


def _times_table(rows: list[Row], n_ranks: int) -> str:
    found = {(row["part"], row["mode"]): row for row in rows}
    body = []
    for part in dict.fromkeys(row["part"] for row in rows):
        one, many = (found[part, mode] for mode in MODES)
        wall = [f"{statistics.median(row['wall']):.3f}" for row in (one, many)]
        ratios = [estimate(_quartiles(one[clock], many[clock])) for clock in ("wall", "cpu")]
        body.append([part, *wall, *ratios])
    head = ["", "one process, s", f"{n_ranks} ranks, s", "speed-up",
            "CPU time / that of the busier rank"]  # fmt: skip
    return markdown(head, body)


def _quartiles(one: list[float], many: list[float]) -> Estimate:
    """Return the median and the quartiles of the rounds' ratios."""
    ratios = [a / b for a, b in zip(one, many, strict=True)]
    low, middle, high = statistics.quantiles(ratios, n=4)
    return Estimate(middle, low, high)


class Ring(NamedTuple):
    """The cost of messages in a ring of processes.

    A reduction by a ring of W ranks takes 2(W - 1) hops, each with 1/W of the bytes. Each message
    costs the same besides, whatever W: packing it, waking up, a minibatch too small to be
    efficient.

    Attributes
    ----------
    per_hop, per_byte, per_message
        Seconds.
    """

    per_hop: float
    per_byte: float
    per_message: float = 0.0

    def seconds(self, number: float, total_bytes: float, n_ranks: int) -> float:
        """Return the cost of the messages."""
        hops = 2 * (n_ranks - 1)
        reducing = number * hops * self.per_hop + total_bytes * hops / n_ranks * self.per_byte
        return number * self.per_message + reducing


def fit_ring(reductions: list[Row], n_ranks: int) -> Ring:
    """Return the costs of a hop and a byte, from the smallest and the largest reduction."""
    fastest = {row["bytes"]: row["seconds"] for row in reductions}
    small, large = min(fastest), max(fastest)
    hops = 2 * (n_ranks - 1)
    per_byte = (fastest[large] - fastest[small]) / (large - small) * n_ranks / hops
    return Ring(fastest[small] / hops, per_byte)


def model_tables(
    results: dict[str, list[Row]], n_critic: int, critic: int, n_others: int, others: int
) -> Iterator[str]:
    """Yield what more ranks would do, each with the timesteps that one process had.

    What the measured ranks' update took beyond its share of the work and its reductions is laid on
    the messages. Work and messages are taken at their fastest, when other processes disturbed them
    least.
    """
    (case,) = results["circumstances"]
    ring = fit_ring(results["reductions"], case["ranks"])
    one, many = (
        {row["part"]: min(row["wall"]) for row in results["times"] if row["mode"] == mode}
        for mode in MODES
    )
    number, total = n_others + n_critic, others + n_critic * critic
    explained = one["update"] / case["ranks"] + ring.seconds(number, total, case["ranks"])
    ring = ring._replace(per_message=max(0.0, many["update"] - explained) / number)
    work = one["collection"] + one["update"]
    yield (
        f"{1e6 * ring.per_message:.0f} µs a message and {1e6 * ring.per_hop:.0f} µs a hop, "
        f"{1e-9 / ring.per_byte:.1f} GB/s, {work:.2f} s of work an update"
    )
    body = []
    for own in (case["batch size"], case["timesteps"]):  # a rank's part of a minibatch
        minibatches = n_critic * case["batch size"] / own
        for n_ranks in RANKS:
            waiting = ring.seconds(n_others + minibatches, others + minibatches * critic, n_ranks)
            rate = n_ranks / (work + waiting)
            body.append([n_ranks, f"{n_ranks} · {own}", f"{waiting:.2f}",
                         f"{100 * work / (work + waiting):.0f} %",
                         f"{rate * case['timesteps']:,.0f}",
                         f"{rate * case['episodes']:,.1f}"])  # fmt: skip
    head = ["ranks", "`batch_size`", "messages, s", "efficiency", "timesteps/s", "episodes/s"]
    yield markdown(head, body)


def main() -> None:
    """Measure under torchrun, or print the measurements."""
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
        for part, rows in results.items():
            RESULTS.replace(part, rows)
    print("\n\n".join(tables(RESULTS.read())))


if __name__ == "__main__":
    main()
