"""Images of the renderer on request, one at a time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from morgs_mi.codec.frame_source import FrameSource
from morgs_mi.core.camera import Camera
from morgs_mi.core.checks import LARGEST
from morgs_mi.core.color_space import exposed
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.png import png_bytes
from morgs_mi.playback.player import available_channels, channel_image, render
from morgs_mi.playback.stream_header import render_config, stream_exposure

_MOST_PIXELS = 2**24  # a page of 4K has half as many


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
        if not 1 / LARGEST <= motion_scale <= LARGEST or size > _MOST_PIXELS:
            raise ValueError(
                f"expected a motion from {1 / LARGEST:g} to {LARGEST:g}, at most {_MOST_PIXELS} "
                f"pixels, got {motion_scale}, {size}."
            )
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
        if channel not in available_channels(gaussians):
            raise ValueError(f"{stream.path}: expected a channel of the stream, got {channel!r}.")
        values = render(gaussians, camera, (channel,), render_config(stream))[channel]
        values = exposed(values, stream_exposure(stream)) if channel == "color" else values
        return png_bytes(channel_image(channel, values, motion_scale))
