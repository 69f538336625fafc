"""Make what an iterator yields in a background thread, a bounded number of items ahead."""

from __future__ import annotations

import atexit
from collections.abc import Iterable, Iterator
from contextlib import suppress
from queue import Empty, Full, Queue
from threading import Event, Thread
from typing import TypeVar

__all__ = ["prefetched"]

T = TypeVar("T")
_PATIENCE = 0.1  # seconds after which the thread looks whether it is still wanted


class _End:
    """The iterator is exhausted, or has raised `error`."""

    def __init__(self, error: BaseException | None = None) -> None:
        self.error = error


def prefetched(items: Iterable[T], ahead: int = 2, newest: bool = False) -> Iterator[T]:
    """Yield what `items` yields, in order; what it raises is raised here.

    Args:
        items: is iterated in a thread of its own, from the first `next` on until this iterator is closed.
        ahead: so many wait at most, and one more is being made.
        newest: whatever waits when a new one is made is dropped: for sources that cannot wait.
    """
    ready: Queue[T | _End] = Queue(1 if newest else ahead)
    closed = Event()

    def put(item: T | _End) -> None:
        while not closed.is_set():
            try:
                return ready.put(item, timeout=0 if newest else _PATIENCE)
            except Full:
                if newest:
                    with suppress(Empty):
                        ready.get_nowait()

    def work() -> None:
        error = None
        try:
            for item in items:
                put(item)
                if closed.is_set():
                    break
        except BaseException as raised:
            error = raised
        finally:
            if (close := getattr(items, "close", None)) is not None:
                close()
        while newest and not ready.empty() and not closed.wait(0.01):
            pass  # the last one may still be wanted
        put(_End(error))

    worker = Thread(target=work, daemon=True, name="prefetch")

    def stop() -> None:
        closed.set()
        worker.join(timeout=10 * _PATIENCE)  # a source may hang

    # A thread that is within a library when the interpreter ends takes the process down with it.
    atexit.register(stop)
    worker.start()
    try:
        while not isinstance(item := ready.get(), _End):
            yield item
        if item.error is not None:
            raise item.error
    finally:
        stop()
        atexit.unregister(stop)
