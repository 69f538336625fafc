"""Connections of the viewer: limits of their number, and of their time without progress.

uvicorn limits neither: unfinished requests, and responses that the client does not read, would keep
their sockets until the process has no file descriptor left.
"""

from __future__ import annotations

import logging
from functools import cache
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

try:
    import resource
except ImportError:  # Windows, which has no such limit
    resource = None

_LOG = logging.getLogger(__name__)
PATIENCE = 10.0
"""Seconds without progress after which a connection ends."""
_FILES = resource.getrlimit(resource.RLIMIT_NOFILE)[0] if resource else 1024
MOST = max(4, min(_FILES // 5, 256))
"""Number of connections that stay open. Each has a socket and perhaps a file, and as many may wait
to be accepted.
"""


class Connection(H11Protocol):
    """Connection that ends after 10 s without progress. Beyond `MOST`, the oldest one that waits
    for a request ends.
    """

    def connection_made(self, transport: Any) -> None:
        """Begin, and end another connection if there are too many."""
        super().connection_made(transport)
        self._begin = self.loop.time()
        self._check_progress(None)
        connections: set[Any] = self.connections
        if len(connections) > MOST:
            _warn_of_limit()
            waiting = [each for each in connections if not each._is_answered()]
            min(waiting, key=lambda each: each._begin).transport.abort()

    def _is_answered(self) -> bool:
        return self.cycle is not None and not self.cycle.response_complete

    def _check_progress(self, last: tuple[Any, int] | None) -> None:
        """End the connection unless a request or bytes of its answer have passed since `last`, or
        the answer is being made.
        """
        state = (self.cycle, self.transport.get_write_buffer_size())
        if state == last and not (self._is_answered() and not state[1]):
            self.transport.abort()
        if not self.transport.is_closing():
            self.loop.call_later(PATIENCE, self._check_progress, state)


@cache
def _warn_of_limit() -> None:
    _LOG.warning("%d connections are open; beyond, the oldest ones without a request end.", MOST)


def log_limit_once(record: logging.LogRecord) -> bool:
    """Log once that connections cannot be accepted, which asyncio logs for each one: a filter."""
    is_limit = record.getMessage().startswith("socket.accept() out of system resource")
    if is_limit:
        _warn_of_limit()
    return not is_limit
