"""Set up worker processes before they import large libraries, and give them tasks; the standard library only."""

import contextlib
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    as_completed,
    wait,
)
from multiprocessing import connection, get_context, parent_process
from typing import TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")

ONE_THREAD = {
    "PJRT_NPROC": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
"""Environment of a worker: one thread of XLA and of every BLAS, as each core has a worker of its own."""

ONE_AT_A_TIME = threading.Lock()
"""Held by a worker that computes: compiled linear algebra called by two threads at once can hang."""


def spawned_pool(jobs: int) -> ProcessPoolExecutor:
    """A pool of spawned processes with one thread of computation each."""
    return ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=begin)


def end_workers(pool: ProcessPoolExecutor) -> None:
    """End the workers at once, whatever they do; the pool is broken then, and shuts down without waiting for them."""
    for worker in list((pool._processes or {}).values()):
        worker.kill()


def run_tasks(
    executor: Executor,
    call: Callable[[Task], Result],
    tasks: Sequence[Task],
    at_once: int,
    collect: Callable[[Task, Future[Result]], object],
    finishing: Callable[[int], object],
) -> Sequence[Task]:
    """Call for each task; returns the tasks that a broken executor did not take.

    After a first `KeyboardInterrupt` no other task begins, and it is raised again when those that run have ended; a
    second one is raised at once.

    Args:
        at_once: number of tasks that are submitted and not done. One that is submitted may begin after an interruption.
        collect: called with each task and its future, which is done.
        finishing: called with the number of tasks that still run, after a `KeyboardInterrupt`.
    """
    waiting = deque(tasks)
    futures: dict[Future[Result], Task] = {}
    try:
        while waiting or futures:
            with contextlib.suppress(BrokenExecutor):
                while waiting and len(futures) < at_once:
                    futures[executor.submit(call, waiting[0])] = waiting[0]
                    waiting.popleft()
            if not futures:
                break  # the executor takes no more
            for future in wait(futures, return_when=FIRST_COMPLETED).done:
                collect(futures.pop(future), future)
    except KeyboardInterrupt:
        running = [future for future in futures if not future.cancel()]
        unfinished = sum(not future.done() for future in running)
        if unfinished:
            finishing(unfinished)
        for future in as_completed(running):
            collect(futures.pop(future), future)
        raise
    finally:
        for future in futures:
            future.cancel()  # after an error, the tasks that have not begun
    return waiting


def begin() -> None:
    """One thread of computation; a worker outlives neither its parent nor, by Ctrl-C, what it has begun."""
    own = {name: value for name, value in ONE_THREAD.items() if name != "XLA_FLAGS"}
    flags = f"{os.environ.get('XLA_FLAGS', '')} {ONE_THREAD['XLA_FLAGS']}".strip()
    os.environ.update(own | {"XLA_FLAGS": flags})
    with contextlib.suppress(ValueError):  # not in the main thread
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is told, and lets us finish, or kills us
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    """A pool's workers hold both ends of their queue, and would wait on it for ever were the parent killed."""
    connection.wait([sentinel])
    os._exit(1)
