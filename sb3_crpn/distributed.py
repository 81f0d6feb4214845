"""Sums and broadcasts over the ranks of ``torch.distributed``; the identity on one process."""

from __future__ import annotations

import torch
import torch.distributed as dist


def world_size() -> int:
    """Return the number of ranks, 1 without an initialised process group."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def all_sum(tensor: torch.Tensor) -> torch.Tensor:
    """Return Σ_ranks of ``tensor``, equal bit for bit on every rank.

    Parameters
    ----------
    tensor
        Same shape and dtype on every rank; left unchanged.
    """
    if world_size() == 1:
        return tensor
    total = tensor.clone()
    dist.all_reduce(total)
    return total


def broadcast(tensor: torch.Tensor, source: int = 0) -> torch.Tensor:
    """Return the ``tensor`` of rank ``source`` on every rank."""
    if world_size() == 1:
        return tensor
    copy = tensor.clone()
    dist.broadcast(copy, source)
    return copy
