"""Frames of synchronised live cameras for a loop of your own, in place of recorded clips.

A source yields the images of one camera, at the size of its recorded clip:

- an int: a camera of this machine, by OpenCV's index;
- a path or URL: anything that FFmpeg opens, e.g. ``/dev/video0`` or ``rtsp://...``;
- an iterable of arrays uint8 [H, W, 3], RGB, with None for a missed instant.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import count
from pathlib import Path
from threading import Event

import numpy as np

from morgs_mi.capture.capture import Capture, PartialFrame
from morgs_mi.io.prefetch import prefetched
from morgs_mi.studio.live.feed import close_images
from morgs_mi.studio.live.playing import ClipClock, is_video, play
from morgs_mi.studio.live.reading import read_camera

Source = int | str | Path | Iterable[np.ndarray | None]


def live_frames(
    rig: Capture, sources: Sequence[Source], newest: bool = False
) -> Iterator[PartialFrame]:
    """Yield the frames of live sources, undistorted, downscaled and colour-corrected like those of
    `rig`.

    A background thread reads one image of each source in turn; the cameras must be synchronised. A
    source that fails or ends is left out. The frames end when no source yields an image any more.

    Args:
        rig: a capture of the same cameras.
        sources: one per camera of the rig.
        newest: whether to drop all but the newest of the frames that arrive while one is being
            processed.

    Raises:
        OSError: a source cannot be opened.
        ValueError: the number of sources differs from the number of cameras, or an image from the
            size of the rig's.
    """
    _check_count(rig, len(sources))
    stop = Event()
    streams = [_images(source, stop) for source in sources]
    return prefetched(_frames(rig, streams), newest=newest, closed=stop)


def _check_count(rig: Capture, count: int) -> None:
    if count != len(rig.cameras):
        raise ValueError(
            f"live_frames(): `sources` must be one for each of {len(rig.cameras)} cameras "
            f"({', '.join(rig.names)}), got {count}."
        )


def _frames(rig: Capture, streams: Sequence[Iterator[np.ndarray | None]]) -> Iterator[PartialFrame]:
    try:
        for index in count():
            images = [next(stream, None) for stream in streams]
            if all(image is None for image in images):
                return
            yield _frame(rig, index, images)
    finally:
        for stream in streams:
            close_images(stream)


def _frame(rig: Capture, index: int, images: Sequence[np.ndarray | None]) -> PartialFrame:
    """Return the frame of the images as they are recorded, one per camera."""
    for view, image in enumerate(images):
        _check_size(rig, view, image)
    processed = (
        None if image is None else rig.process(view, image) for view, image in enumerate(images)
    )
    names = (name for name, image in zip(rig.names, images, strict=True) if image is None)
    return PartialFrame(index, tuple(processed), tuple(f"{name}: no image" for name in names))


def _check_size(rig: Capture, view: int, image: np.ndarray | None) -> None:
    width, height = rig.recorded_sizes[view]
    if image is not None and (image.shape != (height, width, 3) or image.dtype != np.uint8):
        raise ValueError(
            f"live_frames(): the images of {rig.names[view]} must be uint8 [{height}, {width}, 3] "
            f"as in its clip, got {image.dtype} {list(image.shape)}; calibrate at the live size."
        )


def _images(source: Source, stop: Event) -> Iterator[np.ndarray | None]:
    if isinstance(source, int | str | Path):
        if is_video(source):
            return play(source, ClipClock(), stop)
        return read_camera(source, stop, reconnect=False)  # the other cameras would wait for it
    return iter(source)
