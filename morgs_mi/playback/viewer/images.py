"""Images of this machine for the viewer: rendered ones, one at a time, and recorded ones."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.codec.frame_source import FrameSource
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.platform.checks import LARGEST, check_number, require
from morgs_mi.platform.png import png_bytes
from morgs_mi.playback.player import available_channels, picture
from morgs_mi.playback.stream_header import (
    fitted_capture,
    metadata_entry,
    num_frames,
    open_stream_capture,
)

_MOST_PIXELS = 2**24  # a page of 4K has half as many
# Frames that are decoded and dropped rather than seeking, which decodes from a keyframe of the
# video.
_NEAR = 8


class ExactImages:
    """Images of a stream, which `opened` returns as it is now, rendered one at a time in a thread.

    Of the requests that wait for it, the newest wins.
    """

    def __init__(self, opened: Callable[[], FrameSource]) -> None:
        self._opened = opened
        self._newest = 0
        self._lock = asyncio.Lock()
        self._decoded: tuple[Any, Gaussians] | None = None
        self._thread = ThreadPoolExecutor(1, "renderer")

    async def png(
        self, frame: int, channel: str, camera: Camera, motion_scale: float
    ) -> bytes | None:
        """Return an image as PNG, or None if a newer one was requested while this one waited.

        `channel` and `motion_scale` are as for `channel_image`.

        Raises:
            OSError, ValueError: the stream is broken, or has no such frame or channel, or the image
                is too large.
        """
        size = camera.width * camera.height
        check_number("png()", "motion_scale", motion_scale, f"[{1 / LARGEST}, {LARGEST}]")
        check_number("png()", "width * height", size, f"[1, {_MOST_PIXELS}]")
        self._newest += 1
        number = self._newest
        async with self._lock:
            if number != self._newest:
                return None
            work = (self._render, frame, channel, camera, motion_scale)
            return await asyncio.get_running_loop().run_in_executor(self._thread, *work)

    def _render(self, frame: int, channel: str, camera: Camera, motion_scale: float) -> bytes:
        stream = self._opened()
        # The last Gaussians stay decoded as long as the file is the same.
        status = stream.path.stat()
        key = (frame, stream.path, status.st_ino, status.st_mtime_ns)
        if self._decoded is None or self._decoded[0] != key:
            self._decoded = (key, stream.seek(frame).gaussians)
        gaussians = self._decoded[1]
        require(
            channel in available_channels(gaussians),
            stream.path,
            "expected a channel of the stream",
            repr(channel),
            "load the page again",
        )
        return png_bytes(picture(stream, gaussians, camera, channel, motion_scale))


class RecordedImages:
    """Recorded images by camera and frame.

    Args:
        folder: capture; None: the one that was fitted, which the `capture.json` beside the stream
            names. A stream from anybody may name any folder of this machine.
        is_public: whether other machines can see the images. They are then of a folder that the
            user names, or of one that has the fingerprint in the stream's header.
    """

    def __init__(self, folder: Path | None, is_public: bool = False) -> None:
        self._folder = folder
        self._is_public = is_public
        self._capture: Capture | None = None
        self._view = -1
        self._next = 0
        self._images: Iterator[np.ndarray | Exception] = iter(())
        self._lock = Lock()

    def are_present(self, stream: FrameSource) -> bool:
        """Return whether the folder of the capture is there, and may be shown."""
        try:
            return self._folder_of(stream).is_dir()
        except (OSError, ValueError):
            return False

    def _folder_of(self, stream: FrameSource) -> Path:
        """Return the folder of the capture.

        Raises:
            FileNotFoundError: no path is stored, or the folder is not there any more.
            ValueError: nothing shows that the stream was fitted to it, and the images are public.
        """
        if self._folder is not None:
            return self._folder
        has_mark = metadata_entry(stream, "fingerprint") is not None
        require(
            has_mark or not self._is_public,
            stream.path,
            "expected the fingerprint of its recording, because other machines see the images",
            "none",
            "name the recording with --capture",
        )
        return Path(fitted_capture(stream))

    def at(self, stream: FrameSource, view: int, frame: int) -> np.ndarray:
        """Return the image [H, W, 3] of a camera at a frame, undistorted as for the fit.

        Raises:
            OSError, ValueError: the capture is missing, broken, or not the one of the stream; or
                the image was not recorded.
        """
        last = max(stream.frame_numbers(), default=-1)
        require(
            view < len(stream.cameras) and frame <= last,
            stream.path,
            "expected a camera and a frame of the stream",
            f"{view} and {frame}",
            "load the page again",
        )
        with self._lock:
            # The capture of a live fit grows.
            if self._capture is None or frame >= self._capture.num_frames:
                frames = list(range(max(num_frames(stream), last + 1)))
                folder = self._folder_of(stream)
                self._capture = open_stream_capture(stream, folder, frames).displayed()
                self._view = -1
            if view != self._view or not self._next <= frame < self._next + _NEAR:
                self._images = self._capture.images(view, frame)
                self._view = view
                self._next = frame
            image = next(islice(self._images, frame - self._next, None), None)
            self._next = frame + 1
        if not isinstance(image, np.ndarray):
            raise ValueError(f"{self._capture.path}: camera {view} has no image of frame {frame}.")
        return image
