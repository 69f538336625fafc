"""Access control of the viewer: it accepts connections only from its own page, under a name of this machine.

A web page of another site can open a WebSocket to a server on this machine; browsers report it in `Origin` but do not
prevent it. By DNS rebinding, such a page can also point its own name at this machine, and so share its origin; then
`Host` is a foreign name. An address in digits or `localhost` cannot be rebound.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from threading import Event, Lock
from typing import Any
from urllib.parse import urlsplit

__all__ = ["checked_connections", "refusal"]

_PATCHING = Lock()
_WAIT = 0.01  # seconds between two looks at whether the scene is ready
_LOG = logging.getLogger(__name__)
# websockets logs a traceback for a connection that is closed before its first request.
_LOG.addFilter(lambda record: record.getMessage() != "opening handshake failed")


def refusal(host: str | None, origin: str | None, names: Collection[str] = ()) -> str | None:
    """Return why a request is refused, None if it is accepted.

    Args:
        host: the request's `Host`, the address that the browser believes to be talking to.
        origin: the request's `Origin`; programs other than browsers send none.
        names: allowed names in addition to `localhost` and addresses in digits.
    """
    name = urlsplit(f"//{host or ''}").hostname or ""
    if not (_is_address(name) or name in {"localhost", *map(str.lower, names)}):
        return (
            f"morgs-mi view: expected a request for localhost or an address in digits, got the host {name!r}; "
            f"if it is a name of this machine, add --allowed-names {name or 'NAME'}."
        )
    if origin is not None and urlsplit(origin).netloc.lower() != (host or "").lower():
        return (
            f"morgs-mi view: expected a connection from the viewer's own page at {host}, got one from {origin!r}; "
            "open the viewer's address itself."
        )
    return None


@contextmanager
def checked_connections(names: Collection[str] = (), ready: Event | None = None) -> Iterator[None]:
    """Refuse connections according to `refusal` in the viser server that is started in this context.

    Until `ready` is set, pages load but do not connect. viser passes no options to the `serve` of websockets.
    Therefore that function is replaced while viser starts.

    Raises:
        RuntimeError: no server was started through `serve`, so its connections would not be checked.
    """
    import websockets.asyncio.server as server

    original, started = server.serve, []

    def serve(*args: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        async def process(connection: Any, request: Any) -> Any:
            # `get` raises for a header that is sent twice, which websockets answers with an error.
            reason = refusal(request.headers.get("Host"), request.headers.get("Origin"), names)
            if reason is not None:
                return connection.respond(HTTPStatus.FORBIDDEN, reason + "\n")
            response = process_request(connection, request)
            while response is None and ready is not None and not ready.is_set():
                await asyncio.sleep(_WAIT)
            return response

        started.append(True)
        return original(*args, process_request=process, logger=_LOG, **options)

    with _PATCHING:
        server.serve = serve
        try:
            yield
        finally:
            server.serve = original
    if not started:
        raise RuntimeError("checked_connections(): expected viser to serve through websockets; install viser 1.1.")


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
