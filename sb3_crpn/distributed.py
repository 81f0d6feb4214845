"""One run on several processes: ranks, and sums and broadcasts over them.

Without a process group of ``torch.distributed`` every function is the identity on one process.
docs/DISTRIBUTED.md says how a run is started and what is shared.
"""

from __future__ import annotations

import atexit
import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta

import numpy as np
import torch
import torch.distributed as dist

from sb3_crpn.arrays import FloatArray

# How long a rank waits for the others: longer than any evaluation that rank 0 makes alone. A rank
# whose process ends is noticed at once.
TIMEOUT = timedelta(minutes=30)

_local_mode = False


class RankError(RuntimeError):
    """Another rank has ended, or does not answer."""


def init_from_env(timeout: timedelta = TIMEOUT) -> None:
    """Join the process group that ``torchrun`` describes in the environment, if it does.

    Tensors on CPUs are reduced by gloo; tensors on GPUs by NCCL where each rank has a GPU of its
    own, which becomes its current device, and by gloo where ranks share one.

    Parameters
    ----------
    timeout
        How long to wait for another rank before giving up with :class:`RankError`.
    """
    if dist.is_initialized() or int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return
    backend, n_gpus = "gloo", torch.cuda.device_count()
    if n_gpus:
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")) % n_gpus)
        if int(os.environ.get("LOCAL_WORLD_SIZE", "1")) <= n_gpus:
            backend = "cpu:gloo,cuda:nccl"
    # Optimisers import this module, whose functions' defaults are the group of that time: imported
    # later it would keep this one, whose threads would outlive _leave and may abort the exit.
    importlib.import_module("torch.distributed.nn.functional")
    dist.init_process_group(backend, timeout=timeout)
    atexit.register(_leave)


def _leave() -> None:
    if dist.is_initialized():
        dist.destroy_process_group()


def world_size() -> int:
    """Return the number of ranks, 1 without an initialised process group."""
    return dist.get_world_size() if _grouped() else 1


def rank() -> int:
    """Return this process's number, 0 … world_size - 1."""
    return dist.get_rank() if _grouped() else 0


def _grouped() -> bool:
    return not _local_mode and dist.is_available() and dist.is_initialized()


@contextmanager
def local_mode() -> Iterator[None]:
    """Let the block be a run of one process, for what one rank does while the others wait."""
    global _local_mode
    outer, _local_mode = _local_mode, True
    try:
        yield
    finally:
        _local_mode = outer


@contextmanager
def _waiting() -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:  # of whatever backend
        raise RankError(
            f"rank {rank()} of {world_size()} lost another rank, which ended or did not answer in "
            f"time: its own output says why. Training ends; saved files are intact. {error}"
        ) from error


def all_sum(tensor: torch.Tensor) -> torch.Tensor:
    """Return Σ_ranks of ``tensor``, equal bit for bit on every rank.

    Parameters
    ----------
    tensor
        Same shape and dtype on every rank; left unchanged.

    Raises
    ------
    RankError
        Another rank has ended, or does not answer; so does every function below.
    """
    return tensor if world_size() == 1 else _reduce(tensor, dist.ReduceOp.SUM)


def all_max(value: float) -> float:
    """Return the largest of the ranks' values, none of them nan."""
    if world_size() == 1:
        return value
    return float(_reduce(torch.tensor(value, dtype=torch.float64), dist.ReduceOp.MAX))


def _reduce(tensor: torch.Tensor, operation: dist.ReduceOp.RedOpType) -> torch.Tensor:
    result = tensor.detach().clone(memory_format=torch.contiguous_format)
    with _waiting():
        dist.all_reduce(result, operation)
    return result


def broadcast(tensor: torch.Tensor) -> torch.Tensor:
    """Return the ``tensor`` of rank 0 on every rank."""
    if world_size() == 1:
        return tensor
    copy = tensor.detach().clone(memory_format=torch.contiguous_format)
    with _waiting():
        dist.broadcast(copy, 0)
    return copy


def broadcast_state(module: torch.nn.Module) -> None:
    """Give the parameters and buffers of ``module`` the bits of rank 0, one message per dtype."""
    if world_size() == 1:
        return
    tensors = [*module.parameters(), *module.buffers()]
    for dtype in dict.fromkeys(tensor.dtype for tensor in tensors):
        alike = [tensor for tensor in tensors if tensor.dtype == dtype]
        flat = broadcast(torch.cat([tensor.detach().reshape(-1) for tensor in alike]))
        pieces = torch.split(flat, [tensor.numel() for tensor in alike])
        with torch.no_grad():
            for tensor, piece in zip(alike, pieces, strict=True):
                tensor.copy_(piece.view_as(tensor))


def gather_counts(count: int) -> list[int]:
    """Return the counts of all ranks, in their order."""
    counts = torch.zeros(world_size(), dtype=torch.int64)
    counts[rank()] = count
    return [int(number) for number in all_sum(counts)]


def mean_and_variance(values: FloatArray) -> tuple[float, float]:
    """Return mean and variance (of the population) of the union of the ranks' arrays [n]."""
    count, total = all_sum(torch.tensor([len(values), values.sum()], dtype=torch.float64)).tolist()
    mean = total / count
    squares = torch.tensor(((values - mean) ** 2).sum(), dtype=torch.float64)
    return mean, all_sum(squares).item() / count


def local_count(number: int) -> int:
    """Return this rank's part of ``number`` things that are spread evenly."""
    return number // world_size() + (rank() < number % world_size())


def rank_seed(seed: int, *more: int) -> int:
    """Return the seed of this rank, in [0, 2^32): on rank 0 ``seed``, else a hash.

    The hash is of ``seed``, the rank and ``more`` numbers (NumPy's ``SeedSequence``), so that
    runs with the same seed and number of ranks repeat each other.
    """
    if rank() == 0:
        return seed
    return int(np.random.SeedSequence((seed, rank(), *more)).generate_state(1)[0])
