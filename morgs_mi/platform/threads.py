"""Work of NumPy and OpenCV side by side in threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def map_in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Return the results of a function for all items, in order, computed in as many threads as
    there are usable cores.

    It pays for functions that spend their time in NumPy and OpenCV, which release the interpreter's
    lock.
    """
    with ThreadPoolExecutor(usable_cores()) as pool:
        return list(pool.map(function, items))


def in_background(function: Callable[[], Result]) -> Future[Result]:
    """Return the future result of a function that runs in a thread of its own."""
    pool = ThreadPoolExecutor(1)
    future = pool.submit(function)
    pool.shutdown(wait=False)
    return future


def usable_cores() -> int:
    """Return the number of cores that this process may use, which ``taskset`` and containers
    restrict.
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
