"""Workers: processes of a Dask cluster, on this machine or on several, and the conditions in which
they run a task.

A task is a function of the package without side effects. If its worker dies, Dask runs it again
with the same result.
"""

from __future__ import annotations

import gc
import logging
import os
import platform
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Any

import cv2
import drjit as dr
import mitsuba as mi

from morgs_mi.platform.checks import require
from morgs_mi.platform.environment import versions
from morgs_mi.platform.interrupts import postponed
from morgs_mi.platform.threads import usable_cores

if TYPE_CHECKING:
    from distributed import Client

# Seconds after which a scheduler that does not answer counts as lost.
TIMEOUT = 10
_SETTINGS = {
    "distributed.comm.timeouts.connect": TIMEOUT,
    "distributed.admin.large-graph-warning-threshold": "1GB",  # a task has the Gaussians before it
    # A worker that waits keeps its memory; one with too much is ended.
    "distributed.worker.memory.pause": False,
}
_LOST = (
    ConnectionError,
    "a scheduler that answers, but the connection was lost; start it again",
)
# Errors of Dask by the names of their classes, and what they mean.
_FAULTS = {
    "KilledWorker": (
        ChildProcessError,
        "the workers to stay alive, but all died that ran one task, perhaps for lack of memory; "
        "use fewer workers, or process smaller images",
    ),
    "CommClosedError": _LOST,
    "ClosedClientError": _LOST,
    "FutureCancelledError": _LOST,
}
_BUSY = threading.Lock()  # Dask runs several tasks at once in a worker with several threads


@contextmanager
def open_client(scheduler: str | None = None, count: int | None = None) -> Iterator[Client]:
    """Start workers on this machine, or connect to those of a scheduler.

    Args:
        scheduler: address of a Dask scheduler, such as ``tcp://host:8786``; None: workers are
            started.
        count: number of workers to start, with equal shares of cores and memory; None: one per
            core.

    Raises:
        ValueError: Dask is missing.
        ConnectionError: no scheduler answers at the address, it has no worker, or is lost later.
        ChildProcessError: the workers died that ran a task.
    """
    try:
        import dask.config
        import distributed
    except ImportError:
        raise ValueError(
            "open_client(): workers need the package distributed; pip install 'morgs-mi[cluster]'."
        ) from None
    for name in ("distributed", "distributed.client"):  # what concerns a fit is raised
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(_SETTINGS))
        # A client that found no scheduler ends when it is collected, which waits forever for a lock
        # if it happens while another one begins.
        gc.collect()
        address: Any = scheduler
        if scheduler is None:
            # These processes run `python -c`, which would import modules of the current folder.
            safe_path = os.environ.get("PYTHONSAFEPATH", "")
            stack.callback(os.environ.update, PYTHONSAFEPATH=safe_path)
            os.environ["PYTHONSAFEPATH"] = "1"
            resource_tracker.ensure_running()  # it would let the workers have Ctrl-C again
            count = count or usable_cores()
            with postponed():
                address = stack.enter_context(
                    distributed.LocalCluster(
                        n_workers=count,
                        threads_per_worker=max(1, usable_cores() // count),
                        dashboard_address=":0",
                        silence_logs=logging.CRITICAL,
                    )
                )
        problem = "none"
        try:
            client = distributed.Client(address, timeout=TIMEOUT, set_as_default=False)
            stack.enter_context(client)
            problem = "no worker"
            client.wait_for_workers(1, timeout=TIMEOUT)
        except (OSError, ValueError):
            raise ConnectionError(
                f"{scheduler}: expected a scheduler with workers, got {problem}; start it first."
            ) from None
        try:
            yield client
        except (Exception, CancelledError) as error:
            name = type(error).__name__
            if name not in _FAULTS:
                raise
            kind, fault = _FAULTS[name]
            raise kind(f"{scheduler or 'this machine'}: expected {fault}.") from None


def num_workers(client: Client) -> int:
    """Return the number of workers, which may change."""
    return len(client.scheduler_info(n_workers=-1).get("workers", ()))


def worker_name() -> str:
    """Return the address of the worker that runs this task, or else this machine's name."""
    worker = _worker()
    return socket.gethostname() if worker is None else worker.address


def _worker() -> Any:
    with suppress(ImportError, ValueError):
        from distributed import get_worker

        return get_worker()
    return None


def installed() -> tuple[tuple[str, str], ...]:
    """Return the versions that must be the same in client and workers."""
    return tuple({**versions(), "python": ".".join(platform.python_version_tuple()[:2])}.items())


@contextmanager
def prepared(variant: str, versions: tuple[tuple[str, str], ...]) -> Iterator[list[str]]:
    """Run a task alone in this process, with its variant and threads; the context is a list of its
    warnings.

    Args:
        variant: Mitsuba variant of the client.
        versions: as `installed` returned them to the client.

    Raises:
        ValueError: the worker has other versions than the client.
    """
    require(
        versions == installed(),
        socket.gethostname(),
        f"expected a worker with the client's versions, {dict({*versions} - {*installed()})}",
        dict({*installed()} - {*versions}),
        "install the same versions on both",
    )
    messages: list[str] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: messages.append(record.getMessage())
    log = logging.getLogger("morgs_mi")
    with _BUSY:
        log.addHandler(handler)
        try:
            mi.set_variant(variant)
            worker = _worker()
            threads = usable_cores() if worker is None else worker.state.nthreads
            dr.set_thread_count(threads)
            cv2.setNumThreads(threads)
            yield messages
        finally:
            log.removeHandler(handler)
