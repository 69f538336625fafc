"""Images of one camera, stream or pipe as they arrive."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np

__all__ = ["open_source", "raw_images", "read_camera", "read_opened"]

# Reads that may fail in succession before a source counts as ended, and the pause after each, s.
_FAILURES, _PAUSE = 10, 0.02
_RETRY = 1.0  # pause before a connection is opened again, s


def read_camera(source: int | str | Path, size: tuple[int, int] | None = None) -> Iterator[np.ndarray | None]:
    """Yield the images of a source, RGB uint8 [H, W, 3], as they arrive, with None where a read has failed.

    A video file is played at its own speed. A connection that breaks is opened again.

    Args:
        source: a camera of this machine, by OpenCV's index; or a path or URL that FFmpeg opens.
        size: width and height that are requested of a camera of this machine.

    Raises:
        OSError: the source cannot be opened.
    """
    yield from read_opened(open_source(source), source, size)
    while "://" in str(source):
        time.sleep(_RETRY)
        yield None
        with suppress(OSError):
            yield from read_opened(open_source(source), source, size)


def read_opened(
    stream: cv2.VideoCapture, source: int | str | Path, size: tuple[int, int] | None = None
) -> Iterator[np.ndarray | None]:
    """Yield the images of an opened source until it ends, as `read_camera` does; `stream` is released."""
    if isinstance(source, int) and size is not None:
        stream.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
        stream.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
    is_file = not isinstance(source, int) and Path(source).is_file()
    failures, start = 0, time.monotonic()
    try:
        while failures < _FAILURES:
            read, image = stream.read()
            if read and is_file:
                time.sleep(max(0.0, start + stream.get(cv2.CAP_PROP_POS_MSEC) / 1000 - time.monotonic()))
            failures = 0 if read else failures + 1
            yield cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if read else None
            if not read:
                time.sleep(_PAUSE)
    finally:
        stream.release()


def open_source(source: int | str | Path) -> cv2.VideoCapture:
    """Return OpenCV's reader of a camera, by its index, or of anything that FFmpeg opens.

    Raises:
        OSError: it cannot be opened.
    """
    stream = cv2.VideoCapture(source) if isinstance(source, int) else cv2.VideoCapture(str(source), cv2.CAP_FFMPEG)
    if not stream.isOpened():
        raise OSError(f"open_source(): cannot open the source {source}; check that it exists and is not in use.")
    return stream


def raw_images(pipe: BinaryIO, width: int, height: int) -> Iterator[np.ndarray]:
    """Yield the images of a pipe of raw RGB images, 8 bits per channel, until it ends."""
    size = 3 * width * height
    while len(data := _exactly(pipe, size)) == size:
        yield np.frombuffer(data, np.uint8).reshape(height, width, 3)


def _exactly(pipe: BinaryIO, size: int) -> bytes:
    """Return `size` bytes, fewer only at the end of the file: one read of a pipe may return fewer."""
    data = bytearray()
    while len(data) < size and (chunk := pipe.read(size - len(data))):
        data += chunk
    return bytes(data)
