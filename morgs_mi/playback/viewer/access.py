"""Access control of the viewer: it answers only its own page, under a name of this machine, and to
holders of a token.

A web page of another site can send requests to a server on this machine; browsers report it in
`Origin` and `Sec-Fetch-Site` but do not prevent it. By DNS rebinding, such a page can also point
its own name at this machine; then `Host` is a foreign name. An address in digits or `localhost`
cannot be rebound.
"""

from __future__ import annotations

import secrets
from ipaddress import ip_address
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

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
