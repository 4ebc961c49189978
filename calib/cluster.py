"""A cluster's workers as an executor, for `calib.calibrate_many`; Dask is an extra."""

import contextlib
from collections.abc import Iterator
from concurrent.futures import Executor

from .session import SessionError

try:
    from distributed import Client
except ImportError:
    Client = None

_PATIENCE = 10  # s, for a scheduler to answer


@contextlib.contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """The workers of a Dask scheduler; start them with ``dask worker ADDRESS --nthreads 1``, one a core.

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
        yield client.get_executor()
