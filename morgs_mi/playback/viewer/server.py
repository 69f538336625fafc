"""A stream in the browser: the page of `export.web`, which follows a fit that is running, with
images of this machine.

- `/`: the page.
- `/stream.morgs`: the stream, or the provisional first frame beside it; also ranges of its bytes.
- `/recorded/VIEW/FRAME`: recorded image of a camera, JPEG.
- `/exact/FRAME/CHANNEL`: image of the renderer, PNG, for the camera in the query, as JSON of a
  stream's header; 204 if a newer image was requested meanwhile.
"""

from __future__ import annotations

import logging
import os
import re
import secrets
import socket
from collections.abc import Iterator
from contextlib import suppress
from ipaddress import ip_address
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO
from urllib.parse import quote

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route

from morgs_mi.codec.container import HEAD, MAGIC, PAYLOAD, PREAMBLE, camera_of_fields, load_json
from morgs_mi.codec.frame_source import FrameSource
from morgs_mi.codec.reader import StreamReader
from morgs_mi.platform.bounded import open_regular
from morgs_mi.platform.files import PROVISIONAL, STREAM
from morgs_mi.platform.png import jpeg_bytes
from morgs_mi.playback.export.web import published_bytes, served_page
from morgs_mi.playback.streams import SplatFile
from morgs_mi.playback.viewer.access import MOST, Access, Connection, log_limit_once
from morgs_mi.playback.viewer.images import ExactImages, RecordedImages

_GRACE = 1  # seconds for answers that are under way at the end
_MOST_CAMERA_BYTES = 4096
_READ_SIZE = 2**20
# One range of bytes; others are ignored, as HTTP allows. 15 digits: more than any file has bytes.
_RANGE = re.compile(r"bytes=(\d{1,15})-(\d{0,15})", re.ASCII)
_OPTIONS: dict[str, Any] = {
    "log_level": "error",
    "http": Connection,
    "backlog": MOST,
    "lifespan": "off",
    "ws": "none",
    "proxy_headers": False,
    "timeout_graceful_shutdown": _GRACE,
}


class Viewer:
    """Server of a page that shows a stream.

    Args:
        stream: stream, which may still be written, or file of Gaussians, as `open_stream` returns
            it.
        host: IPv4 address or name of the server. If other machines can reach it, the link has a
            random token.
        port: port of the server; 0: a free one.
        capture: folder of the capture with the recorded images; None: the one that was fitted.

    Attributes:
        url: link to the page.
        is_public: whether other machines can reach it.

    Raises:
        ValueError: the address cannot be used, or the file of Gaussians is broken.
    """

    def __init__(
        self,
        stream: FrameSource,
        host: str = "127.0.0.1",
        port: int = 0,
        capture: Path | None = None,
    ) -> None:
        self._stream = stream
        # A link may be named, but not replace the file later.
        self._path = Path(os.path.realpath(stream.path))
        if isinstance(stream, SplatFile):
            self._folder = TemporaryDirectory()
            self._path = Path(self._folder.name) / STREAM
            self._path.write_bytes(published_bytes(stream))
        self._exact = ExactImages(self._opened)
        try:
            self._socket = socket.create_server((host, port))
        except (OSError, OverflowError) as error:
            raise ValueError(
                f"{host}:{port}: cannot serve the page there ({error}); choose another --port, or "
                "the IPv4 address of this machine."
            ) from None
        address, port = self._socket.getsockname()[:2]
        self.is_public = not ip_address(address).is_loopback
        self._recorded = RecordedImages(capture, self.is_public)
        token = secrets.token_urlsafe() if self.is_public else ""
        name = "localhost" if ip_address(address).is_unspecified else host
        self.url = f"http://{name}:{port}/{token and token + '/'}"
        routes = [
            Route("/", self._send_page),
            Route(f"/{STREAM}", self._send_stream),
            Route("/recorded/{view:int}/{frame:int}", self._send_recorded),
            Route("/exact/{frame:int}/{channel}", self._send_exact),
        ]
        app = Starlette(routes=routes, exception_handlers={OSError: _failed, ValueError: _failed})
        self._server = uvicorn.Server(uvicorn.Config(Access(app, host, token), **_OPTIONS))

    def run(self) -> None:
        """Serve the page until `stop` is called, or a signal, which is raised again after the
        server has ended.
        """
        logging.getLogger("asyncio").addFilter(log_limit_once)
        with self._socket:
            self._server.run(sockets=[self._socket])

    def stop(self) -> None:
        """End `run`."""
        self._server.should_exit = True

    def close(self) -> None:
        """Release the address of a page that is not served."""
        self._socket.close()

    def _newest(self) -> Path:
        """Return the path of the stream, or of the provisional first frame beside it while it has
        no frame.
        """
        provisional = self._path.with_name(PROVISIONAL)
        return (
            provisional
            if provisional.is_file() and not StreamReader(self._path, follow=False).index()
            else self._path
        )

    def _opened(self) -> FrameSource:
        """Return the stream as it is now; a file of Gaussians stays as it was opened."""
        return (
            self._stream
            if isinstance(self._stream, SplatFile)
            else StreamReader(self._newest(), follow=False)
        )

    def _send_page(self, _: Request) -> Response:
        server = "recorded" if self._recorded.are_present(self._stream) else "exact"
        first_frame = None
        with suppress(OSError, ValueError):  # the page itself describes what is wrong with the file
            first_frame = next(iter(self._opened().frame_numbers()), None)
        return HTMLResponse(served_page(self._stream, server=server, poster=first_frame))

    def _send_stream(self, request: Request) -> Response:
        return _stream_response(self._newest(), request)

    def _send_recorded(self, request: Request) -> Response:
        image = self._recorded.at(StreamReader(self._newest(), follow=False), **request.path_params)
        return Response(jpeg_bytes(image), media_type="image/jpeg")

    async def _send_exact(self, request: Request) -> Response:
        query = request.query_params
        camera = camera_of_fields(
            load_json(query.get("camera", "").encode(), _MOST_CAMERA_BYTES), "camera"
        )
        png = await self._exact.png(
            **request.path_params, camera=camera, motion_scale=float(query.get("scale", "nan"))
        )
        return Response(status_code=204) if png is None else Response(png, media_type="image/png")


async def _failed(_: Request, error: Exception) -> Response:
    text = str(error).encode(errors="replace")  # a name may have bytes that are not UTF-8
    return PlainTextResponse(text, 404 if isinstance(error, FileNotFoundError) else 400)


def _stream_response(path: Path, request: Request) -> Response:
    """Return the answer to a request of a file, or of a range of its bytes.

    Bytes that are written meanwhile are left out. The entity tag stays the same while the stream
    grows.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no stream, or no regular file.
    """
    file = open_regular(path, follow=False)  # `_parts` closes it
    size = os.fstat(file.fileno()).st_size
    start = file.read(PREAMBLE.size + PAYLOAD)
    if not MAGIC.startswith(start[: len(MAGIC)]):
        file.close()
        raise ValueError(f"{path}: expected a stream, got another file; fit the capture again.")
    # The tag has the inode and the checksums of the header and of the first frame.
    length = 0
    if len(start) == PREAMBLE.size + PAYLOAD:
        length = HEAD.unpack_from(start, PREAMBLE.size)[2]
    file.seek(min(len(start) + length, size))
    etag = f'"{os.fstat(file.fileno()).st_ino:x}-{start.hex()}-{file.read(PAYLOAD).hex()}"'
    location = quote(os.fsencode(path.name))
    headers = {"ETag": etag, "Accept-Ranges": "bytes", "Content-Location": location}
    part = range(size)
    status = 200
    match = _RANGE.fullmatch(request.headers.get("range", ""))
    if match is not None and request.headers.get("if-range", etag) == etag:
        part = part[int(match[1]) : int(match[2]) + 1 if match[2] else None]
        status = 206
        headers["Content-Range"] = f"bytes {part.start}-{part.stop - 1}/{size}"
    if status == 206 and not part:
        file.close()
        return PlainTextResponse("", 416, {"Content-Range": f"bytes */{size}"})
    # Without the number of bytes: a fit may truncate the file meanwhile, to go on from there.
    return StreamingResponse(_parts(file, part), status, headers, "application/octet-stream")


def _parts(file: BinaryIO, part: range) -> Iterator[bytes]:
    with file:
        file.seek(part.start)
        for start in range(part.start, part.stop, _READ_SIZE):
            yield file.read(min(_READ_SIZE, part.stop - start))
