"""Images of one camera, stream or pipe as they arrive."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from io import FileIO
from pathlib import Path
from select import select
from threading import Event, Thread
from typing import BinaryIO

import cv2
import numpy as np

# Reads that may fail in succession before a source counts as ended, and the pause after each, s.
_FAILURES = 10
PAUSE = 0.02
RETRY = 1.0  # pause before a connection is opened again, s
# Longest wait of FFmpeg for a connection or its next bytes, s; some streams come in parts of a few
# seconds.
_SILENCE = 10.0
# Silence after which the reader of a pipe looks whether it is to end, s, and how many bytes it
# copies at most.
_POLL = 0.3
_CHUNK = 1 << 20


def read_camera(
    source: int | str | Path,
    closed: Event,
    size: tuple[int, int] | None = None,
    reconnect: bool = True,
) -> Iterator[np.ndarray | None]:
    """Yield the images of a source, RGB uint8 [H, W, 3], as they arrive, with None where a read has
    failed.

    Args:
        source: a camera of this machine, by OpenCV's index; or a path or URL that FFmpeg opens.
        closed: is set by another thread to end the images, also of a source that is silent.
        size: width and height that are requested of a camera of this machine.
        reconnect: whether a connection that breaks is opened again.

    Raises:
        OSError: the source cannot be opened.
    """
    yield from _until_end(source, closed, size)
    while reconnect and "://" in str(source) and not closed.wait(RETRY):
        yield None
        with suppress(OSError):
            yield from _until_end(source, closed, size)


def _until_end(
    source: int | str | Path, stop: Event, size: tuple[int, int] | None
) -> Iterator[np.ndarray | None]:
    """Yield the images of a source, which is opened once; see `read_camera`."""
    with _place(source, stop) as place:
        if stop.is_set():
            return
        stream = open_stream(place, source)
        if isinstance(source, int) and size is not None:
            _request_size(stream, *size)
        try:
            yield from _images(stream, stop)
        finally:
            stream.release()


def _request_size(stream: cv2.VideoCapture, width: int, height: int) -> None:
    stream.set(cv2.CAP_PROP_FRAME_WIDTH, width)
    stream.set(cv2.CAP_PROP_FRAME_HEIGHT, height)


def _images(stream: cv2.VideoCapture, stop: Event) -> Iterator[np.ndarray | None]:
    """Yield the images of an open stream until several reads in succession have failed."""
    failures = 0
    while failures < _FAILURES and not stop.is_set():
        is_read, image = stream.read()
        failures = 0 if is_read else failures + 1
        yield cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if is_read else None
        if not is_read:
            stop.wait(PAUSE)


def open_stream(place: int | str, source: int | str | Path) -> cv2.VideoCapture:
    """Return OpenCV's reader of a source at a place.

    Raises:
        OSError: it cannot be opened.
    """
    stream = cv2.VideoCapture(place) if isinstance(place, int) else _ffmpeg_stream(place)
    if not stream.isOpened():
        raise OSError(
            f"open_stream(): cannot open the source {source}; check that it exists and is not in "
            "use."
        )
    return stream


def _ffmpeg_stream(place: str) -> cv2.VideoCapture:
    """Return OpenCV's reader of a path or URL, which waits only so long for a connection."""
    limits = (
        (cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, cv2.CAP_PROP_READ_TIMEOUT_MSEC) if "://" in place else ()
    )
    return cv2.VideoCapture(
        place, cv2.CAP_FFMPEG, [n for key in limits for n in (key, int(1000 * _SILENCE))]
    )


@contextmanager
def _place(source: int | str | Path, stop: Event) -> Iterator[int | str]:
    """Yield what OpenCV is to open for a source; a named pipe is relayed.

    FFmpeg itself waits for a silent named pipe, or for one without a writer, and cannot be
    interrupted. A thread that returns from OpenCV when the interpreter has ended aborts the
    process.
    """
    if isinstance(source, int) or not Path(source).is_fifo():
        yield source if isinstance(source, int) else str(source)
        return
    with _opened_pipe(source) as pipe, _relayed(pipe, stop) as place:
        yield place


def _opened_pipe(path: str | Path) -> FileIO:
    """Return a named pipe, which is opened without waiting for its writer."""
    return open(path, "rb", 0, opener=lambda path, flags: os.open(path, flags | os.O_NONBLOCK))


@contextmanager
def _relayed(pipe: FileIO, stop: Event) -> Iterator[str]:
    """Yield the path of a pipe to which a thread copies another one, from its first bytes on."""
    first = _next_bytes(pipe, False, stop.is_set)
    exit_event = Event()
    reader, writer = os.pipe()
    has_ended = lambda: stop.is_set() or exit_event.is_set()  # noqa: E731
    relay = Thread(target=_relay, args=(pipe, first, writer, has_ended), daemon=True, name="pipe")
    relay.start()
    try:
        yield f"/dev/fd/{reader}"
    finally:
        exit_event.set()
        os.close(reader)  # so a relay that waits for its reader ends, too
        relay.join()


def _relay(pipe: FileIO, data: bytes, writer: int, has_ended: Callable[[], bool]) -> None:
    """Write `data` and the further bytes of a pipe to the file descriptor `writer` until one side
    ends.
    """
    with suppress(BrokenPipeError), open(writer, "wb", 0) as copy:
        while data:
            rest = memoryview(data)
            while rest:
                rest = rest[copy.write(rest) :]
            data = _next_bytes(pipe, True, has_ended)


def _next_bytes(pipe: FileIO, had_writer: bool, has_ended: Callable[[], bool]) -> bytes:
    """Wait for the next bytes of a pipe and return them; none if its writer ended, or if it is
    silent and `has_ended`.

    Args:
        pipe: is opened without waiting for its writer.
        had_writer: whether there was a writer before.
        has_ended: returns whether to give up.
    """
    while True:
        data = pipe.read(_CHUNK) if select([pipe], [], [], _POLL)[0] else None
        if data or (had_writer and data == b""):
            return data
        if has_ended():
            return b""
        if data == b"":
            time.sleep(_POLL)  # on some systems, a pipe without a writer is readable


def raw_images(pipe: BinaryIO, width: int, height: int) -> Iterator[np.ndarray]:
    """Yield the images of a pipe of raw RGB images, 8 bits per channel, until it ends."""
    size = 3 * width * height
    while len(data := _exactly(pipe, size)) == size:
        yield np.frombuffer(data, np.uint8).reshape(height, width, 3)


def _exactly(pipe: BinaryIO, size: int) -> bytes:
    """Return `size` bytes, fewer only at the end: one read of a pipe may return fewer."""
    data = bytearray()
    while len(data) < size and (chunk := pipe.read(size - len(data))):
        data += chunk
    return bytes(data)
