"""Images of live cameras, connections and videos that are played as if they were recorded now.

A source is one of these:

- an int: a camera of this machine, by OpenCV's index;
- a path or URL: anything that FFmpeg opens, e.g. ``/dev/video0`` or ``rtsp://...``;
- for `live_frames`, an iterable of arrays uint8 [H, W, 3], RGB, with None for a missed timestamp.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import count
from math import inf
from pathlib import Path
from threading import Condition, Event
from typing import TypeGuard

import cv2
import numpy as np

from morgs_mi.capture.capture import Capture, PartialFrame, RecordedView
from morgs_mi.extras.live.cameras import CameraFeed
from morgs_mi.extras.live.live_config import LiveConfig
from morgs_mi.io.images import ImageOrError
from morgs_mi.io.prefetch import close_items, prefetched
from morgs_mi.io.video import VideoReader
from morgs_mi.platform.checks import quantity, require

Source = int | str | Path
"""A camera of this machine, by OpenCV's index; or a path or URL that FFmpeg opens."""

RETRY = 1.0  # pause before a source is opened again, s
# Reads in succession that fail before a source counts as ended, and the pause after one, s: a
# camera may lose an image.
_FAILURES = 10
_PAUSE = 0.02
# Longest wait of FFmpeg for a connection or its next bytes, s; some streams come in parts of a few
# seconds.
_SILENCE = 10.0
_POLL = 0.1  # interval at which a clip that waits for others looks whether it is to end, s
_RATE = 30.0  # frames per second of a clip that does not state it
_DESCRIPTIONS = (".sdp", ".m3u8")  # files that name streams


def open_feed(
    sources: Sequence[Source], config: LiveConfig, names: Sequence[str] | None = None
) -> CameraFeed:
    """Return the feed of one source per camera.

    Args:
        sources: one per camera, in the order of `names`.
        config: settings.
        names: names of the cameras; by default cam0, cam1, ...

    Raises:
        ValueError: there is no source, one occurs twice, or their number differs from the number of
            names.
    """
    names = [f"cam{k}" for k in range(len(sources))] if names is None else names
    videos = [source for source in sources if is_video(source)]
    text = f"{len(sources)} ({', '.join(map(str, sources))})"
    rig = f"the {len(names)} calibrated cameras ({', '.join(names)})"
    place = "open_feed()"
    require(sources, place, "`camera` must have a source per camera", "none", "name them")
    are_different = len(set(sources)) == len(sources)
    require(are_different, place, "`camera` must have different sources", text, "name each once")
    require(
        len(names) == len(sources),
        place,
        f"`camera` must have a source for each of {rig}",
        text,
        "name them in that order",
    )
    stop = Event()
    clock = ClipClock(len(videos))

    def images(source: Source) -> Iterator[np.ndarray | None]:
        if is_video(source):
            return play(source, clock, stop, videos.index(source))
        return read_camera(source, stop, config.size)

    cameras = {name: images(source) for name, source in zip(names, sources, strict=True)}
    warm_up = 0.0 if len(videos) == len(sources) else config.warm_up
    return CameraFeed(cameras, config.timeout, warm_up, stop)


def live_frames(
    rig: Capture, sources: Sequence[Source | Iterable[np.ndarray | None]], newest: bool = False
) -> Iterator[PartialFrame]:
    """Yield the frames of live sources, undistorted, downscaled and colour-corrected like those of
    `rig`, for a loop of your own.

    A background thread reads one image of each source in turn; the cameras must be synchronised. A
    source that fails or ends is left out. The frames end when no source yields an image any more.

    Args:
        rig: a capture of the same cameras.
        sources: one per camera of the rig.
        newest: whether to drop all but the newest of the frames that arrive while one is being
            processed.

    Raises:
        OSError: a source cannot be opened.
        ValueError: a video cannot be decoded, the number of sources differs from the number of
            cameras, or an image from the size of the rig's.
    """
    cameras = f"{quantity(len(rig.cameras), 'camera')} ({', '.join(rig.names)})"
    require(
        len(sources) == len(rig.cameras),
        "live_frames()",
        f"`sources` must be one for each of {cameras}",
        len(sources),
        "name them in that order",
    )
    stop = Event()
    streams: list[Iterator[np.ndarray | None]] = []
    for source in sources:
        if is_video(source):
            streams.append(play(source, ClipClock(), stop))
        elif isinstance(source, Source):
            # Opening it again would make the other cameras wait for it.
            streams.append(read_once(source, stop))
        else:
            streams.append(iter(source))

    def process(view: RecordedView, image: np.ndarray | None) -> ImageOrError:
        if image is None:
            return ValueError("no image")
        width, height = view.recorded_size
        require(
            image.shape == (height, width, 3) and image.dtype == np.uint8,
            "live_frames()",
            f"the images of {view.name} must be uint8 [{height}, {width}, 3] as in its clip",
            f"{image.dtype} {list(image.shape)}",
            "calibrate at the live size",
        )
        return view.process(image)

    def frames() -> Iterator[PartialFrame]:
        frame = None
        try:
            for index in count():
                images = [next(stream, None) for stream in streams]
                if all(image is None for image in images):
                    return
                frame = PartialFrame.of(index, rig.views, [*map(process, rig.views, images)], frame)
                yield frame
        finally:
            for stream in streams:
                close_items(stream)

    return prefetched(frames(), newest=newest, closed=stop)


def read_camera(
    source: Source, closed: Event, size: tuple[int, int] | None = None
) -> Iterator[np.ndarray | None]:
    """Yield the images of a source, RGB uint8 [H, W, 3], as they arrive, until `closed` is set. A
    source that ends or fails is opened again, with None for every attempt.

    Args:
        source: a camera of this machine, by OpenCV's index; or a path or URL that FFmpeg opens.
        closed: is set by another thread to end the images.
        size: width and height that are requested of a camera of this machine.

    Raises:
        OSError: the source cannot be opened at first.
    """
    yield from read_once(source, closed, size)
    while not closed.wait(RETRY):
        yield None
        with suppress(OSError):
            yield from read_once(source, closed, size)


def read_once(
    source: Source, closed: Event, size: tuple[int, int] | None = None
) -> Iterator[np.ndarray | None]:
    """Yield the images of a source, which is opened once, with None for a read that fails, until
    ten in succession fail; see `read_camera`.
    """
    if isinstance(source, int):
        stream = cv2.VideoCapture(source)
        if size is not None:
            stream.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
            stream.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
    else:
        # A connection is waited for only so long.
        limit = int(1000 * _SILENCE)
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, limit, cv2.CAP_PROP_READ_TIMEOUT_MSEC, limit]
        stream = cv2.VideoCapture(str(source), cv2.CAP_FFMPEG, limits)
    if not stream.isOpened():
        raise OSError(f"cannot open the source {source}; check that it exists and is not in use.")
    failures = 0
    try:
        while failures < _FAILURES and not closed.is_set():
            is_read, image = stream.read()
            if is_read:
                failures = 0
                yield cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
            else:
                failures += 1
                yield None
                closed.wait(_PAUSE)
    finally:
        stream.release()


def is_video(source: object) -> TypeGuard[str | Path]:
    """Return whether a source is a video file."""
    return (
        isinstance(source, str | Path)
        and Path(source).is_file()
        and Path(source).suffix not in _DESCRIPTIONS
    )


class ClipClock:
    """Common clock of clips that are played at their own speed, or slower if they cannot be decoded
    in time.

    A clip waits until the others have reached its time, as otherwise the ones that are decoded
    faster would run ahead.

    Args:
        clips: their number.
    """

    def __init__(self, clips: int = 1) -> None:
        self._times = [-inf] * clips
        self._start = -inf
        self._change = Condition()

    def wait(self, clip: int, due: float, interval: float, closed: Event) -> None:
        """Wait until it is time for an image of a clip, or `closed` is set.

        Args:
            clip: index of the clip.
            due: time of the image, s.
            interval: time between two images of the clip, s.
            closed: is set by another thread to end the clips.
        """
        with self._change:
            self._times[clip] = due
            self._change.notify_all()
            while min(self._times) < due - interval / 2 and not closed.is_set():
                self._change.wait(_POLL)
            # A late clip does not hurry afterwards.
            self._start = max(self._start, time.monotonic() - due)
            time_left = self._start + due - time.monotonic()
        closed.wait(max(0.0, time_left))

    def leave(self, clip: int) -> None:
        """Let the others go on without a clip."""
        with self._change:
            self._times[clip] = inf
            self._change.notify_all()


def play(path: str | Path, clock: ClipClock, closed: Event, clip: int = 0) -> Iterator[np.ndarray]:
    """Yield the images of a video, RGB uint8 [H, W, 3], at their times.

    Args:
        path: the file.
        clock: of all clips that are played side by side, each in a thread of its own.
        closed: is set by another thread to end the images.
        clip: index of the video among the clips.

    Raises:
        OSError, ValueError: as `VideoReader.open`.
    """
    try:
        for image, at, interval in timed_images(path):
            clock.wait(clip, at, interval, closed)
            if closed.is_set():
                return
            yield image
    finally:
        clock.leave(clip)


def timed_images(path: str | Path) -> Iterator[tuple[np.ndarray, float, float]]:
    """Yield each image of a video, RGB uint8 [H, W, 3], its time from the beginning of the video,
    and the interval between two images, s.

    Raises:
        OSError, ValueError: as `VideoReader.open`.
    """
    reader = VideoReader.open(path)
    interval = 1 / (reader.fps or _RATE)
    for index, image in enumerate(reader.pick(range(reader.num_held))):
        if isinstance(image, np.ndarray):
            at = index * interval if reader.times is None else float(reader.times[index])
            yield image, at, interval
