"""Set up a worker process before it imports large libraries; this module imports the standard library only."""

import contextlib
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import connection, get_context, parent_process

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
