"""Videos that are played side by side, as if they were recorded now."""

from __future__ import annotations

import time
from collections.abc import Iterator
from math import inf
from pathlib import Path
from threading import Condition, Event
from typing import TypeGuard

import numpy as np

from morgs_mi.io.video import VideoReader

_POLL = 0.1  # interval at which a clip that waits for others looks whether it is to end, s
_RATE = 30.0  # frames per second of a clip that does not state it
_DESCRIPTIONS = (".sdp", ".m3u8")  # files that name streams


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

    Attributes:
        length: time after which the clips are repeated, s: the length of the shortest one, once it
            has ended.
    """

    def __init__(self, clips: int = 1) -> None:
        self.length = inf
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


def play(
    path: str | Path, clock: ClipClock, closed: Event, clip: int = 0, loop: bool = False
) -> Iterator[np.ndarray]:
    """Yield the images of a video, RGB uint8 [H, W, 3], at their times.

    Args:
        path: the file.
        clock: of all clips that are played side by side, each in a thread of its own.
        closed: is set by another thread to end the images.
        clip: index of the video among the clips.
        loop: whether to begin again, together with the others, when the shortest clip has ended.

    Raises:
        OSError: the video cannot be opened.
    """
    begin = 0.0
    try:
        while True:
            end = 0.0
            for image, at, interval in timed_images(path):
                clock.wait(clip, begin + at, interval, closed)
                if closed.is_set():
                    return
                if at > clock.length - interval / 2:
                    break
                yield image
                end = at + interval
            else:  # it has ended, before the others
                if not loop:
                    return
                clock.length = min(clock.length, end)
            begin += clock.length
    finally:
        clock.leave(clip)


def timed_images(path: str | Path) -> Iterator[tuple[np.ndarray, float, float]]:
    """Yield each image of a video, RGB uint8 [H, W, 3], its time from the beginning of the video,
    and the interval between two images, s.

    Raises:
        OSError: the video cannot be opened.
    """
    try:
        reader = VideoReader.open(path)
    except ValueError as error:
        raise OSError(str(error)) from None
    interval = 1 / (reader.fps or _RATE)
    for index, image in enumerate(reader.pick(range(reader.num_held))):
        if isinstance(image, np.ndarray):
            at = index * interval if reader.times is None else float(reader.times[index])
            yield image, at, interval
