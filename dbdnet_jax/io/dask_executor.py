"""A cluster that Dask schedules, as an executor."""

import contextlib
from collections.abc import Iterator
from concurrent.futures import Executor

from dbdnet_jax.errors import MissingExtraError

LEAST_ROOM = 32  # for workers that come later
CONNECT_S = 10


@contextlib.contextmanager
def open_dask(address: str) -> Iterator[tuple[Executor, int]]:
    """The executor of the scheduler at ``HOST:PORT``, and how many items keep its workers busy.

    Raises:
      MissingExtraError: Dask is not installed.
      OSError: no scheduler answers there.
    """
    try:
        from dask.distributed import Client
    except ImportError as error:
        raise MissingExtraError(
            f"an executor dask:// needs dask.distributed; importing it failed ({error}). Install "
            'it with `pip install "dbdnet_jax[dask]"`.'
        ) from error
    try:
        client = Client(f"tcp://{address}", timeout=CONNECT_S, set_as_default=False)
    except OSError as error:
        raise OSError(
            f"dask://{address} must be a Dask scheduler that answers within {CONNECT_S} s; "
            f"{error}. Start one with `dask scheduler`."
        ) from error
    with client:
        threads = sum(client.nthreads().values())
        yield client.get_executor(pure=False), max(2 * threads, LEAST_ROOM)
