"""Live images of a calibrated rig, in place of recorded clips.

A source yields the images of one camera, at the size of its recorded clip:

- an int: a camera of this machine, by OpenCV's index;
- a path or URL: anything that FFmpeg opens, e.g. a named pipe, ``/dev/video0`` or ``rtsp://...``;
- a binary file, e.g. the end of a pipe: raw RGB images, 8 bits per channel
  (``ffmpeg ... -f rawvideo -pix_fmt rgb24 -``);
- an iterable of arrays uint8 [H, W, 3], RGB, with None for a missed instant.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import BinaryIO, cast

import cv2
import numpy as np

from morgs_mi.capture.capture import Capture, PartialFrame
from morgs_mi.io.prefetch import prefetched

__all__ = ["Source", "live_frames", "open_source"]

Source = int | str | Path | BinaryIO | Iterable[np.ndarray | None]


def live_frames(rig: Capture, sources: Sequence[Source], newest: bool = False) -> Iterator[PartialFrame]:
    """Yield the frames of live sources, undistorted, downscaled and colour-corrected like those of `rig`.

    A background thread reads one image of each source in turn; the cameras must be synchronised. A source that fails
    or ends is left out. The frames end when no source yields an image any more.

    Args:
        rig: a capture of the same cameras.
        sources: one per camera of the rig.
        newest: whether to drop all but the newest of the frames that arrive while one is being processed.

    Raises:
        OSError: a source cannot be opened.
        ValueError: the number of sources differs from that of the cameras, or an image from the size of the rig's.
    """
    if len(sources) != len(rig.cameras):
        raise ValueError(
            f"live_frames(): `sources` must be one for each of {len(rig.cameras)} cameras ({', '.join(rig.names)}), "
            f"got {len(sources)}."
        )
    streams = [_images(source, *size) for source, size in zip(sources, rig.recorded_sizes, strict=True)]
    return prefetched(_frames(rig, streams), newest=newest)


def _frames(rig: Capture, streams: Sequence[Iterator[np.ndarray | None]]) -> Iterator[PartialFrame]:
    try:
        for index in count():
            images = [next(stream, None) for stream in streams]
            if all(image is None for image in images):
                return
            problems = [f"{n}: no image" for n, image in zip(rig.names, images, strict=True) if image is None]
            for view, image in enumerate(images):
                _check_size(rig, view, image)
            processed = [None if image is None else rig.process(view, image) for view, image in enumerate(images)]
            yield PartialFrame(index, tuple(processed), tuple(problems))
    finally:
        for stream in streams:
            if (close := getattr(stream, "close", None)) is not None:
                close()


def _check_size(rig: Capture, view: int, image: np.ndarray | None) -> None:
    width, height = rig.recorded_sizes[view]
    if image is not None and (image.shape != (height, width, 3) or image.dtype != np.uint8):
        raise ValueError(
            f"live_frames(): the images of {rig.names[view]} must be uint8 [{height}, {width}, 3] as in its clip, "
            f"got {image.dtype} {list(image.shape)}; calibrate at the live size."
        )


def _images(source: Source, width: int, height: int) -> Iterator[np.ndarray | None]:
    if isinstance(source, int | str | Path):
        return _captured(open_source(source))
    if hasattr(source, "read"):
        return _raw(cast(BinaryIO, source), width, height)
    return iter(cast(Iterable[np.ndarray | None], source))


def open_source(source: int | str | Path) -> cv2.VideoCapture:
    """Return OpenCV's reader of a camera, by its index, or of anything that FFmpeg opens.

    Raises:
        OSError: it cannot be opened.
    """
    stream = cv2.VideoCapture(source) if isinstance(source, int) else cv2.VideoCapture(str(source), cv2.CAP_FFMPEG)
    if not stream.isOpened():
        raise OSError(f"live_frames(): cannot open the source {source}; check that it exists and is not in use.")
    return stream


def _captured(stream: cv2.VideoCapture) -> Iterator[np.ndarray | None]:
    try:
        while True:
            ok, image = stream.read()
            yield cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if ok else None
    finally:
        stream.release()


def _raw(pipe: BinaryIO, width: int, height: int) -> Iterator[np.ndarray]:
    size = 3 * width * height
    while len(data := _exactly(pipe, size)) == size:
        yield np.frombuffer(data, np.uint8).reshape(height, width, 3)


def _exactly(pipe: BinaryIO, size: int) -> bytes:
    """Return `size` bytes, fewer only at the end of the file: one read of a pipe may return fewer."""
    data = bytearray()
    while len(data) < size and (chunk := pipe.read(size - len(data))):
        data += chunk
    return bytes(data)
