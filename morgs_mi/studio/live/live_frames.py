"""Frames of synchronised live cameras for a loop of your own, in place of recorded clips.

A source yields the images of one camera, at the size of its recorded clip:

- an int: a camera of this machine, by OpenCV's index;
- a path or URL: anything that FFmpeg opens, e.g. ``/dev/video0`` or ``rtsp://...``;
- an iterable of arrays uint8 [H, W, 3], RGB, with None for a missed timestamp.
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
    if len(sources) != len(rig.cameras):
        raise ValueError(
            f"live_frames(): `sources` must be one for each of {len(rig.cameras)} cameras "
            f"({', '.join(rig.names)}), got {len(sources)}."
        )
    stop = Event()
    streams: list[Iterator[np.ndarray | None]] = []
    for source in sources:
        if is_video(source):
            streams.append(play(source, ClipClock(), stop))
        elif isinstance(source, int | str | Path):
            # Reconnecting would make the other cameras wait for it.
            streams.append(read_camera(source, stop, reconnect=False))
        else:
            streams.append(iter(source))
    return prefetched(_frames(rig, streams), newest=newest, closed=stop)


def _frames(rig: Capture, streams: Sequence[Iterator[np.ndarray | None]]) -> Iterator[PartialFrame]:
    try:
        for index in count():
            images = [next(stream, None) for stream in streams]
            if all(image is None for image in images):
                return
            processed: list[np.ndarray | None] = []
            problems: list[str] = []
            for view, image in enumerate(images):
                width, height = rig.recorded_sizes[view]
                if image is None:
                    processed.append(None)
                    problems.append(f"{rig.names[view]}: no image")
                elif image.shape != (height, width, 3) or image.dtype != np.uint8:
                    raise ValueError(
                        f"live_frames(): the images of {rig.names[view]} must be uint8 "
                        f"[{height}, {width}, 3] as in its clip, got {image.dtype} "
                        f"{list(image.shape)}; calibrate at the live size."
                    )
                else:
                    processed.append(rig.process(view, image))
            yield PartialFrame(index, tuple(processed), tuple(problems))
    finally:
        for stream in streams:
            close_images(stream)
