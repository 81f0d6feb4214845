"""Functions that run on several ranks, one process each."""

import os
import socket
from datetime import timedelta
from pathlib import Path

import torch
import torch.multiprocessing as mp

from sb3_crpn.distributed import init_from_env

TIMEOUT = timedelta(seconds=120)


def run_ranks(functions, folder, n_ranks=2):
    """Call ``function(folder)`` for each of ``functions`` on every rank, started as by torchrun.

    Returns each rank's exit code, and for each function the ranks' results, ``None`` where there
    is none.
    """
    context = mp.get_context("spawn")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    arguments = [(functions, str(folder), rank, n_ranks, port) for rank in range(n_ranks)]
    processes = [context.Process(target=_on_rank, args=each) for each in arguments]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    files = [[_file(folder, f, rank) for rank in range(n_ranks)] for f in functions]
    results = [
        [torch.load(path, weights_only=False) if path.exists() else None for path in paths]
        for paths in files
    ]
    return [process.exitcode for process in processes], results


def _file(folder, function, rank):
    return Path(folder) / f"{function.__name__}_{rank}.pt"


def _on_rank(functions, folder, rank, n_ranks, port):
    torch.set_num_threads(1)
    for name in ("", "LOCAL_"):
        os.environ[f"{name}RANK"], os.environ[f"{name}WORLD_SIZE"] = str(rank), str(n_ranks)
    os.environ["MASTER_ADDR"], os.environ["MASTER_PORT"] = "127.0.0.1", str(port)
    init_from_env(timeout=TIMEOUT)
    for function in functions:
        torch.save(function(folder), _file(folder, function, rank))
