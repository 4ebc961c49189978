"""The workers of a cluster as an executor for `calib.calibrate_many`; Dask is an optional dependency."""

import contextlib
from collections.abc import Iterator
from concurrent.futures import Executor
from typing import Any

from ..session import SessionError

try:
    import distributed
except ImportError:
    Client: Any = None
else:
    Client = distributed.Client

_ANSWER_TIMEOUT = 10  # s: a scheduler in the same network answers within this time


@contextlib.contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """The workers of a Dask scheduler; start them with ``dask worker ADDRESS --nthreads 1``, one per core.

    The memory of a worker grows by some megabytes per session, and Dask does not replace workers as the pool of
    `calib.calibrate_many` does. Options of the worker do this: ``--lifetime 30m --lifetime-stagger 5m
    --lifetime-restart`` restarts a worker after that time, ``--memory-limit 2GB`` at 95 % of that memory. A session
    that the restart interrupted is calibrated again.

    Raises:
        ImportError: Dask is not installed.
        SessionError: no scheduler answers.
    """
    if Client is None:
        raise ImportError("a Dask scheduler needs dask: pip install 'jaxeit[dask]'")
    try:
        client = Client(address, timeout=_ANSWER_TIMEOUT)
    except (OSError, ValueError) as error:
        why = " ".join(str(error).split())
        raise SessionError(f"{address}: no Dask scheduler answers there ({why}); start one: dask scheduler") from error
    with client:
        yield client.get_executor(pure=False)  # a result lies in a folder: what Dask remembers of it may be gone
