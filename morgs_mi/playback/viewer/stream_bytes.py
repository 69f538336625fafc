"""The bytes of a stream file that may grow, in answers to requests of ranges of them."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO
from urllib.parse import quote

from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse

from morgs_mi.codec.container import HEAD, MAGIC, PAYLOAD, PREAMBLE
from morgs_mi.core.bounded import open_regular

_CHUNK = 2**20
# One range of bytes; others are ignored, as HTTP allows. 15 digits: more than any file has bytes.
_RANGE = re.compile(r"bytes=(\d{1,15})-(\d{0,15})", re.ASCII)


def stream_response(path: Path, request: Request) -> Response:
    """Return the answer to a request of a file, or of a range of its bytes.

    Bytes that are written meanwhile are left out. The entity tag stays the same while the stream
    grows.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no stream, or no regular file.
    """
    file = open_regular(path, follow=False)  # `_chunks` closes it
    size = os.fstat(file.fileno()).st_size
    start = file.read(PREAMBLE.size + PAYLOAD)
    if not MAGIC.startswith(start[: len(MAGIC)]):
        file.close()
        raise ValueError(f"{path}: expected a stream, got another file; fit the capture again.")
    etag = _etag(file, size, start)
    location = quote(os.fsencode(path.name))
    headers = {"ETag": etag, "Accept-Ranges": "bytes", "Content-Location": location}
    part = _requested_bytes(request, etag, size)
    if part is not None and not part:
        file.close()
        return PlainTextResponse("", 416, {"Content-Range": f"bytes */{size}"})
    status = 200 if part is None else 206
    if part is None:
        part = range(size)
    else:
        headers["Content-Range"] = f"bytes {part.start}-{part.stop - 1}/{size}"
    # Without the number of bytes: a fit may truncate the file meanwhile, to go on from there.
    return StreamingResponse(_chunks(file, part), status, headers, "application/octet-stream")


def _requested_bytes(request: Request, etag: str, size: int) -> range | None:
    """Return the range that a request names, None if it is for the whole file."""
    match = _RANGE.fullmatch(request.headers.get("range", ""))
    if match is None or request.headers.get("if-range", etag) != etag:
        return None
    return range(size)[int(match[1]) : int(match[2]) + 1 if match[2] else None]


def _etag(file: BinaryIO, size: int, start: bytes) -> str:
    """Return an entity tag of a file's inode and the checksums of its header and first frame;
    `start` are its first bytes.
    """
    length = (
        HEAD.unpack_from(start, PREAMBLE.size)[2] if len(start) == PREAMBLE.size + PAYLOAD else 0
    )
    file.seek(min(len(start) + length, size))
    return f'"{os.fstat(file.fileno()).st_ino:x}-{start.hex()}-{file.read(PAYLOAD).hex()}"'


def _chunks(file: BinaryIO, part: range) -> Iterator[bytes]:
    with file:
        file.seek(part.start)
        for start in range(part.start, part.stop, _CHUNK):
            yield file.read(min(_CHUNK, part.stop - start))
