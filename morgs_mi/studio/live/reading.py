"""Images of one camera or stream as they arrive."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from threading import Event

import cv2
import numpy as np

# Reads that may fail in succession before a source counts as ended, and the pause after each, s.
_FAILURES = 10
PAUSE = 0.02
RETRY = 1.0  # pause before a connection is opened again, s
# Longest wait of FFmpeg for a connection or its next bytes, s; some streams come in parts of a few
# seconds.
_SILENCE = 10.0


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
        closed: is set by another thread to end the images.
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
    """Yield the images of a source, which is opened once, until several reads in succession have
    failed; see `read_camera`.
    """
    if stop.is_set():
        return
    stream = open_stream(source)
    if isinstance(source, int) and size is not None:
        stream.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
        stream.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
    failures = 0
    try:
        while failures < _FAILURES and not stop.is_set():
            is_read, image = stream.read()
            failures = 0 if is_read else failures + 1
            yield cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if is_read else None
            if not is_read:
                stop.wait(PAUSE)
    finally:
        stream.release()


def open_stream(source: int | str | Path) -> cv2.VideoCapture:
    """Return OpenCV's reader of a source.

    Raises:
        OSError: it cannot be opened.
    """
    if isinstance(source, int):
        stream = cv2.VideoCapture(source)
    else:
        # A connection is waited for only so long.
        limit = int(1000 * _SILENCE)
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, limit, cv2.CAP_PROP_READ_TIMEOUT_MSEC, limit]
        place = str(source)
        stream = cv2.VideoCapture(place, cv2.CAP_FFMPEG, limits if "://" in place else [])
    if not stream.isOpened():
        raise OSError(
            f"open_stream(): cannot open the source {source}; check that it exists and is not in "
            "use."
        )
    return stream
