"""Pictures of a calibrated rig as they come, instead of recorded clips.

A source is whatever gives one camera's pictures, of the size that its clip was recorded at:

- an int: a camera of this machine, by OpenCV's index;
- a path or URL: whatever FFmpeg can open, e.g. a named pipe, ``/dev/video0`` or ``rtsp://...``;
- a binary file, e.g. the end of a pipe: raw RGB pictures, 8 bits each (``ffmpeg ... -f rawvideo -pix_fmt rgb24 -``);
- an iterable of arrays uint8 [H, W, 3], RGB, with None for an instant that it has missed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np

from morgs_mi.capture.capture import Capture, PartialFrame
from morgs_mi.io.prefetch import prefetched

__all__ = ["Source", "live_frames"]

Source = int | str | Path | BinaryIO | Iterable[np.ndarray | None]


def live_frames(rig: Capture, sources: Sequence[Source], newest: bool = False) -> Iterator[PartialFrame]:
    """Yield the frames of live sources as `rig` would see them: lenses undone, downscaled, colours corrected.

    One picture is taken of each source in turn, in a background thread; that they belong to one instant is up to the
    cameras. A source that fails or ends is left out; it is over when none gives a picture any more.

    Args:
        rig: a capture of the same cameras.
        sources: one per camera of the rig.
        newest: frames that come while the last one is still in use are dropped but for the newest.

    Raises:
        OSError: a source cannot be opened.
        ValueError: there is not one source per camera, or a picture has another size than the rig's.
    """
    if len(sources) != len(rig.cameras):
        raise ValueError(
            f"live_frames(): `sources` must be one for each of {len(rig.cameras)} cameras ({', '.join(rig.names)}), "
            f"got {len(sources)}."
        )
    streams = [_pictures(source, *size) for source, size in zip(sources, rig.recorded_sizes, strict=True)]
    return prefetched(_frames(rig, streams), newest=newest)


def _frames(rig: Capture, streams: Sequence[Iterator[np.ndarray | None]]) -> Iterator[PartialFrame]:
    try:
        for index in count():
            pictures = [next(stream, None) for stream in streams]
            if all(picture is None for picture in pictures):
                return
            problems = [f"{n}: no picture" for n, p in zip(rig.names, pictures, strict=True) if p is None]
            for view, picture in enumerate(pictures):
                _check_size(rig, view, picture)
            images = [None if p is None else rig.seen(view, p) for view, p in enumerate(pictures)]
            yield PartialFrame(index, tuple(images), tuple(problems))
    finally:
        for stream in streams:
            if (close := getattr(stream, "close", None)) is not None:
                close()


def _check_size(rig: Capture, view: int, picture: np.ndarray | None) -> None:
    width, height = rig.recorded_sizes[view]
    if picture is not None and (picture.shape != (height, width, 3) or picture.dtype != np.uint8):
        raise ValueError(
            f"live_frames(): the pictures of {rig.names[view]} must be uint8 [{height}, {width}, 3] as in its clip, "
            f"got {picture.dtype} {list(picture.shape)}; calibrate at the live size."
        )


def _pictures(source: Source, width: int, height: int) -> Iterator[np.ndarray | None]:
    if isinstance(source, int | str | Path):
        stream = cv2.VideoCapture(source) if isinstance(source, int) else cv2.VideoCapture(str(source), cv2.CAP_FFMPEG)
        if not stream.isOpened():
            raise OSError(
                f"live_frames(): the source {source} cannot be opened; check that it is there and not in use."
            )
        return _captured(stream)
    return iter(source) if not hasattr(source, "read") else _raw(source, width, height)


def _captured(stream: cv2.VideoCapture) -> Iterator[np.ndarray | None]:
    try:
        while True:
            ok, picture = stream.read()
            yield cv2.cvtColor(picture, cv2.COLOR_BGR2RGB) if ok else None
    finally:
        stream.release()


def _raw(pipe: BinaryIO, width: int, height: int) -> Iterator[np.ndarray]:
    size = 3 * width * height
    while len(data := _exactly(pipe, size)) == size:
        yield np.frombuffer(data, np.uint8).reshape(height, width, 3)


def _exactly(pipe: BinaryIO, size: int) -> bytes:
    """Read `size` bytes, less only at the end: pipes give what they have."""
    data = bytearray()
    while len(data) < size and (chunk := pipe.read(size - len(data))):
        data += chunk
    return bytes(data)
