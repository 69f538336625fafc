"""Run an iterator in a background thread, a bounded number of items ahead."""

from __future__ import annotations

import atexit
from collections.abc import Generator, Iterable
from contextlib import suppress
from dataclasses import dataclass
from queue import Empty, Full, Queue
from threading import Event, Thread
from typing import TypeVar

T = TypeVar("T")
_POLL_SECONDS = 0.1  # interval at which the thread checks whether the consumer has closed
_CLOSING_SECONDS = 12.0  # longest wait for the thread; a connection may take 10 s to break


@dataclass
class _End:
    """Marker of the iterator's end, with the `error` that it raised."""

    error: BaseException | None


def close_items(items: object) -> None:
    """End an iterator, if it is one that can be ended."""
    if (close := getattr(items, "close", None)) is not None:
        close()


def prefetched(
    items: Iterable[T], ahead: int = 2, newest: bool = False, closed: Event | None = None
) -> Generator[T, None, None]:
    """Yield the items of `items`, in order; an error that it raises is raised here.

    Args:
        items: iterated in a separate thread, from the first `next` until this generator is closed.
        ahead: maximum number of items that wait, while one more is being produced.
        newest: whether a new item replaces the one that waits, for sources that cannot wait.
        closed: is set when this generator is closed; `items` ends then, if it waits for something.
    """
    ready: Queue[T | _End] = Queue(1 if newest else ahead)
    closed = closed or Event()

    def put(item: T | _End) -> None:
        while not closed.is_set():
            try:
                return ready.put(item, timeout=0 if newest else _POLL_SECONDS)
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
            close_items(items)
        while newest and not ready.empty() and not closed.wait(0.01):
            pass  # the consumer may still take the last item
        put(_End(error))

    worker = Thread(target=work, daemon=True, name="prefetch")

    def stop() -> None:
        closed.set()
        worker.join(timeout=_CLOSING_SECONDS)

    # A thread that executes library code when the interpreter ends aborts the process.
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
