"""A cluster's workers as an executor, for `calib.calibrate_many`; Dask is an extra."""

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

_PATIENCE = 10  # s, for a scheduler to answer


@contextlib.contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """The workers of a Dask scheduler; start them with ``dask worker ADDRESS --nthreads 1``, one a core.

    Memory of a worker grows by some megabytes a session, and Dask does not renew workers as the pool of
    `calib.calibrate_many` does. Have its nanny do it: ``--lifetime 30m --lifetime-stagger 5m --lifetime-restart``
    starts one anew after so long, ``--memory-limit 2GB`` one that passes 95 % of that. What it was at is done again.

    Raises:
        ImportError: Dask is not installed.
        SessionError: no scheduler answers.
    """
    if Client is None:
        raise ImportError("a Dask scheduler needs dask: pip install 'jaxeit[dask]'")
    try:
        client = Client(address, timeout=_PATIENCE)
    except (OSError, ValueError) as error:
        why = " ".join(str(error).split())
        raise SessionError(f"{address}: no Dask scheduler answers there ({why}); start one: dask scheduler") from error
    with client:
        yield client.get_executor(pure=False)  # a result lies in a folder: what Dask remembers of it may be gone
