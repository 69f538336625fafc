"""The one place where work leaves this process: an executor of processes on this machine, or of a Dask cluster.

Everything else awaits `Workers.run`. A task is a function of the package with plain arguments, and returns bytes. If
its worker dies, it is run again; tasks have no side effects, and the result is the same.
"""

from __future__ import annotations

import asyncio
import logging
import multiprocessing
import os
import signal
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from typing import Any, TypeVar

from morgs_mi.core.interrupts import interrupts_raised

__all__ = ["Workers", "cores", "open_workers", "share_of_machine", "wait_for"]

Item = TypeVar("Item")
Result = TypeVar("Result")

_ATTEMPTS = 3
_POLL = 0.02  # seconds between two looks for a worker that is free; their number may grow
# Seconds after which a scheduler that does not answer counts as lost.
_TIMEOUT = 10
# Cores and bytes of this process as a worker on one machine, by name; set when it starts.
_SHARE: dict[str, int] = {}


class Workers(ABC):
    """Workers that run tasks.

    Attributes:
        place: where they are, for messages.
    """

    place: str

    @property
    @abstractmethod
    def count(self) -> int:
        """Number of workers, which may grow.

        Raises:
            ConnectionError: the scheduler was lost.
        """

    @abstractmethod
    async def run(self, function: Callable[..., Result], *args: Any) -> Result:
        """Return the result of a task.

        Raises:
            ChildProcessError: its worker died, and those died that repeated it.
            ConnectionError: the scheduler was lost.
            Exception: what the task raised.
        """

    async def map(self, function: Callable[[Item], Coroutine[Any, Any, None]], items: Iterable[Item]) -> None:
        """Await a function of each item, of at most `count` items at once.

        Raises:
            Exception: the first that `function` raised; the others are cancelled.
        """
        running = set[asyncio.Task[None]]()
        try:
            async with asyncio.TaskGroup() as group:
                for item in items:
                    while len(running) >= self.count:
                        await asyncio.wait(running, timeout=_POLL, return_when=asyncio.FIRST_COMPLETED)
                    task = group.create_task(function(item))
                    running.add(task)
                    task.add_done_callback(running.discard)
        except BaseExceptionGroup as errors:
            raise errors.exceptions[0] from None


class _Processes(Workers):
    """Processes of this machine, each in a pool of its own: only its task dies with it."""

    place = "this machine"

    def __init__(self, count: int) -> None:
        self._share = {"threads": max(1, cores() // count), "memory": _memory() // count}
        self._free = [self._pool() for _ in range(count)]
        self._all = list(self._free)

    @property
    def count(self) -> int:
        return len(self._all)

    async def run(self, function: Callable[..., Result], *args: Any) -> Result:
        while not self._free:
            await asyncio.sleep(_POLL)
        pool = self._free.pop()  # the last one that was at work, which may continue its loop
        try:
            for _ in range(_ATTEMPTS):
                try:
                    return await asyncio.wrap_future(pool.submit(function, *args))
                except BrokenProcessPool:
                    self._all.remove(pool)
                    _end(pool)
                    pool = self._pool()
                    self._all.append(pool)
        finally:
            self._free.append(pool)
        raise ChildProcessError(_died(f"{_ATTEMPTS} processes"))

    def close(self) -> None:
        """End the processes, also those that are at work."""
        for pool in self._all:
            _end(pool)

    def _pool(self) -> ProcessPoolExecutor:
        # Dr.Jit and forked processes do not go together.
        return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _begin, (self._share,))


class _DaskWorkers(Workers):
    """Workers of a Dask cluster, which repeats the tasks of those that die."""

    def __init__(self, client: Any, place: str) -> None:
        self.place, self._client, self._executor = place, client, client.get_executor(pure=False)

    @property
    def count(self) -> int:
        about = self._client.scheduler_info(n_workers=-1)
        if "workers" not in about:
            raise ConnectionError(_lost(self.place))
        return len(about["workers"])

    async def run(self, function: Callable[..., Result], *args: Any) -> Result:
        try:
            return await asyncio.wrap_future(self._executor.submit(function, *args))
        except asyncio.CancelledError:
            task = asyncio.current_task()
            if task is None or task.cancelling():
                raise
            raise ConnectionError(_lost(self.place)) from None  # Dask cancels what a lost scheduler ran
        except Exception as error:
            if type(error).__name__ == "KilledWorker":
                raise ChildProcessError(_died("the workers")) from None
            if isinstance(error, RuntimeError) and "deserialization" in str(error):
                raise ValueError(
                    f"{self.place}: expected a scheduler and workers with the versions of this client, got others that "
                    "cannot read its tasks; install the same versions on all machines."
                ) from None
            if type(error).__name__ in ("CommClosedError", "ClosedClientError", "FutureCancelledError"):
                raise ConnectionError(_lost(self.place)) from None
            raise


@interrupts_raised()
def wait_for(work: Coroutine[Any, Any, Result]) -> Result:
    """Run a coroutine that awaits tasks, and return its result; an interruption is raised without further messages."""

    def report(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        if not isinstance(context.get("exception"), KeyboardInterrupt):
            loop.default_exception_handler(context)

    async def reported() -> Result:
        asyncio.get_running_loop().set_exception_handler(report)
        return await work

    return asyncio.run(reported())


def _died(what: str) -> str:
    return (
        f"Workers.run(): expected the workers to stay alive, but {what} died at the same task, perhaps for lack of "
        "memory; use fewer workers, or process smaller images."
    )


def _lost(place: str) -> str:
    return f"{place}: expected a scheduler that answers, but the connection was lost; start it again."


@contextmanager
def open_workers(scheduler: str | None = None, count: int | None = None) -> Iterator[Workers]:
    """Start workers, or connect to the workers of a scheduler.

    Args:
        scheduler: None: processes on this machine; ``local``: a Dask cluster on this machine; otherwise the address of
            a Dask scheduler, such as ``tcp://host:8786``.
        count: number of workers on this machine; None: one per core. Their share of cores and memory is equal.

    Raises:
        ValueError: the number or the address is not one, or Dask is missing.
        ConnectionError: the scheduler does not answer, or has no worker.
    """
    if count is not None and count < 1:
        raise ValueError(f"open_workers(): `workers` must be at least 1, got {count}.")
    with _processes(count or cores()) if scheduler is None else _dask_workers(scheduler, count or cores()) as workers:
        yield workers


@contextmanager
def _processes(count: int) -> Iterator[Workers]:
    """Start processes on this machine."""
    workers = _Processes(count)
    try:
        yield workers
    finally:
        workers.close()


def _begin(share: dict[str, int]) -> None:
    """Prepare a process: it ends with its parent, which alone reacts to Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()
    _SHARE.update(share)


def _end(pool: ProcessPoolExecutor) -> None:
    processes = list((pool._processes or {}).values())
    with suppress(OSError):  # it is just breaking
        pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        process.terminate()


@contextmanager
def _dask_workers(scheduler: str, count: int) -> Iterator[Workers]:
    """Connect to a Dask cluster; `count` workers are started for a local one."""
    try:
        import dask.config
        from distributed import Client, LocalCluster
    except ImportError:
        raise ValueError(
            f"open_workers(): `scheduler={scheduler}` needs the package distributed; pip install 'morgs-mi[cluster]'."
        ) from None
    if scheduler != "local" and "://" not in scheduler:
        raise ValueError(
            f"open_workers(): `scheduler` must be local or an address such as tcp://host:8786, got {scheduler}."
        )
    with ExitStack() as stack:
        stack.enter_context(dask.config.set({"distributed.comm.timeouts.connect": _TIMEOUT}))
        address: Any = scheduler
        if scheduler == "local":
            threads = max(1, cores() // count)
            address = LocalCluster(count, threads, dashboard_address=":0", silence_logs=logging.CRITICAL)
            stack.enter_context(address)
        found = "none"
        try:
            client = stack.enter_context(Client(address, timeout=_TIMEOUT, set_as_default=False))
            found = "no worker"
            client.wait_for_workers(1, timeout=_TIMEOUT)
        except (OSError, ValueError):
            raise ConnectionError(
                f"{scheduler}: expected a scheduler with workers, got {found}; start it first."
            ) from None
        yield _DaskWorkers(client, scheduler)


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def share_of_machine() -> tuple[int, int]:
    """Return the number of threads and of bytes of memory that this worker may use; 0 bytes: no limit is known."""
    if _SHARE:
        return _SHARE["threads"], _SHARE["memory"]
    with suppress(ImportError, ValueError):
        from distributed import get_worker

        worker: Any = get_worker()
        # A little less than the 95 % at which its nanny ends it without a message.
        return worker.state.nthreads, int(0.9 * (worker.memory_manager.memory_limit or 0))
    return cores(), 0


def _memory() -> int:
    """Return the bytes of this machine's memory."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
