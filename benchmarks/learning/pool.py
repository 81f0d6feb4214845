"""Runs in parallel processes, each stored as it ends."""

from __future__ import annotations

import os
import signal
import threading
import traceback
import warnings
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path

import torch
from tqdm import tqdm

from benchmarks.learning import store
from benchmarks.learning.run import Result, Run, execute


def run_all(runs: Sequence[Run], n_jobs: int, folder: Path) -> int:
    """Run all, storing each as it ends; return how many failed."""
    n_failed = 0
    os.environ["OMP_NUM_THREADS"] = "1"  # before the workers import torch
    with (
        ProcessPoolExecutor(n_jobs, get_context("spawn"), _start_worker) as pool,
        tqdm(total=len(runs), smoothing=0, unit="run") as bar,
    ):
        futures = {pool.submit(execute, run): run for run in runs}
        try:
            for future in as_completed(futures):
                n_failed += not _store_result(futures[future], future, folder)
                bar.update()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in active_children():
                process.terminate()
            raise
    return n_failed


def _store_result(run: Run, future: Future[Result], folder: Path) -> bool:
    try:
        result = future.result()
    except BrokenProcessPool:
        raise
    except Exception:
        tqdm.write(f"failed: {run}\n{traceback.format_exc()}")
        return False
    store.append(folder, run, result)
    return True


def _start_worker() -> None:
    """Make a worker polite, single-threaded, and end with its parent."""
    os.nice(10)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent terminates its workers
    warnings.filterwarnings("ignore")
    parent = parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    torch.set_num_threads(1)
