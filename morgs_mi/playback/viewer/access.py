"""Access control of the viewer: hosts, tokens, and limits of connections and of idle time.

A web page of another site can send requests to a server on this machine; browsers report it in
`Origin` and `Sec-Fetch-Site` but do not prevent it. By DNS rebinding, such a page can also point
its own name at this machine; then `Host` is a foreign name. An address in digits or `localhost`
cannot be rebound.

uvicorn limits neither connections nor their time: unfinished requests, and responses that the
client does not read, would keep their sockets until the process has no file descriptor left.
"""

from __future__ import annotations

import logging
import secrets
from functools import cache
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
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
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",  # the address has the token
    "X-Content-Type-Options": "nosniff",
}


def refusal(headers: Headers, name: str) -> str | None:
    """Return why a request is refused, None if it is accepted; `name` may be the host, as may an
    address in digits.
    """
    host = headers.get("host", "")
    origin = headers.get("origin")
    try:
        hostname = urlsplit(f"//{host}").hostname or ""
        page = host if origin is None else urlsplit(origin).netloc
    except ValueError:  # brackets that hold no address
        return f"expected a host and an origin, got {host!r} and {origin!r}"
    if hostname not in ("localhost", name.lower()) and not _is_address(hostname):
        return (
            f"expected a request for localhost or an address in digits, got the host {hostname!r}"
        )
    if page.lower() != host.lower():
        return f"expected a request of the viewer's own page at {host}, got one of {origin!r}"
    site = headers.get("sec-fetch-site", "none")
    if site not in ("same-origin", "none") and headers.get("sec-fetch-mode") != "navigate":
        return "expected a request of the viewer's own page, got one of another page"
    return None


class Access:
    """ASGI middleware: 403 unless `token`, if any, is the first part of the path, and `refusal`
    accepts the request.
    """

    def __init__(self, app: ASGIApp, name: str, token: str) -> None:
        self._app = app
        self._name = name
        self._prefix = f"/{token}" if token else ""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        reason = refusal(Headers(scope=scope), self._name)
        start = scope["path"][: len(self._prefix) + 1]
        has_token = secrets.compare_digest(start.encode(), f"{self._prefix}/".encode())
        if reason is None and not has_token:
            reason = "expected the token of the printed link in the address"

        async def secured(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)

        app = self._app if reason is None else PlainTextResponse(f"morgs-mi view: {reason}.\n", 403)
        await app({**scope, "path": scope["path"][len(self._prefix) :]}, receive, secured)


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


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
