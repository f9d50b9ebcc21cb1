"""Workers: local processes, or the workers of a scheduler on the network."""

import argparse
import logging
import re
from contextlib import ExitStack, closing, contextmanager, suppress

from .. import machine
from ..command_line import UsageError

CONNECT_SECONDS = 20
CLOSE_SECONDS = 20
MOST_LOCAL = 256


def workers(text):
    """Convert the value of `--workers` to a number of local processes (int) or the address of a scheduler (str); an
    argparse type."""
    if re.fullmatch(r"(tcp|tls|ws|wss|ucx)://.+:\d+", text):
        return text
    if not text.isdecimal() or not 0 < int(text) <= MOST_LOCAL:
        raise argparse.ArgumentTypeError(
            f"'{text}' is neither a number of processes, 1 to {MOST_LOCAL}, nor the address of a scheduler such as "
            "tcp://HOST:8786"
        )
    return int(text)


def import_dask():
    """Import and return `distributed`; raises UsageError if it is missing."""
    try:
        import distributed
    except ModuleNotFoundError as error:
        raise UsageError(
            f"--workers needs the package '{error.name}'; pip install 'manylights[cluster]' brings it"
        ) from None
    return distributed


@contextmanager
def connected(wanted, threads=None):
    """Yield a `Pool` of workers; `wanted` is a result of `workers`. Local processes share `threads` (default: all
    cores) and end with the block. Workers of a scheduler have `threads` each (default: all cores of their machine).
    Raises UsageError if no scheduler answers."""
    distributed = import_dask()
    from .pool import Pool

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # `Pool` logs the fate of workers
    with ExitStack() as stack:
        address = wanted
        if isinstance(wanted, int):
            address, threads = stack.enter_context(_processes(distributed, wanted)), _share(wanted, threads)
        try:
            pool = Pool(lambda: distributed.Client(address, timeout=CONNECT_SECONDS), threads)
        except OSError as error:
            raise UsageError(f"--workers: no scheduler answers at {address} ({error})") from None
        except TypeError as error:  # Dask's settings name no certificate
            raise UsageError(f"--workers: {address} needs Dask's settings for TLS ({error})") from None
        yield stack.enter_context(closing(pool))


@contextmanager
def _processes(distributed, count):
    """Yield the address of a scheduler in this process with worker processes, all on the loopback interface."""
    cluster = distributed.LocalCluster(
        n_workers=count, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0", memory_limit=0,
        silence_logs=logging.CRITICAL,
    )  # fmt: skip
    try:
        yield cluster.scheduler_address
    finally:
        with suppress(TimeoutError):  # they end with this process
            cluster.close(timeout=CLOSE_SECONDS)


def _share(count, threads):
    return max(1, (threads or machine.cores()) // count)
