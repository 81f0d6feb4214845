"""Jobs in parallel processes. Each result is handled when its job ends."""

from __future__ import annotations

import os
import signal
import threading
import traceback
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context, parent_process
from typing import TypeVar

from tqdm import tqdm

Job = TypeVar("Job")
Result = TypeVar("Result")


def run_all(
    work: Callable[[Job], Result],
    jobs: Sequence[Job],
    keep: Callable[[Job, Result], None],
    *,
    n_processes: int,
) -> int:
    """Run all jobs and return how many failed.

    Parameters
    ----------
    work
        Job ↦ result; a function of a module, for it runs in other processes.
    jobs
        In the order in which they start.
    keep
        Called with each job and its result as it ends, in this process.
    n_processes
        How many run at a time, each in one thread and polite to other work.

    Raises
    ------
    BrokenProcessPool
        A process died.
    """
    os.environ["OMP_NUM_THREADS"] = "1"  # before the workers import torch
    n_failed = 0
    with (
        ProcessPoolExecutor(n_processes, get_context("spawn"), _start_worker) as pool,
        tqdm(total=len(jobs), smoothing=0, unit="job") as bar,
    ):
        futures = {pool.submit(work, job): job for job in jobs}
        try:
            for future in as_completed(futures):
                n_failed += not _handle(futures[future], future, keep)
                bar.update()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in active_children():
                process.terminate()
            raise
    return n_failed


def _handle(job: Job, future: Future[Result], keep: Callable[[Job, Result], None]) -> bool:
    """Keep a job's result, or print why there is none; return whether there was one."""
    try:
        result = future.result()
    except BrokenProcessPool:
        raise
    except Exception:
        tqdm.write(f"failed: {job}\n{traceback.format_exc()}")
        return False
    keep(job, result)
    return True


def _start_worker() -> None:
    """Make a worker polite, single-threaded, and end with its parent."""
    import torch

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
