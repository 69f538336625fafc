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
    return StreamingResponse(_chunks(file, part), status, headers, "application/octet-stream")


def _chunks(file: BinaryIO, part: range) -> Iterator[bytes]:
    with file:
        file.seek(part.start)
        for start in range(part.start, part.stop, _CHUNK):
            yield file.read(min(_CHUNK, part.stop - start))
