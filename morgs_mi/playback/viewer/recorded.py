"""Recorded images of a stream: random access to the images of its capture."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from threading import Lock

import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.codec.frame_source import FrameSource
from morgs_mi.playback.stream_header import fitted_capture, num_frames, open_stream_capture

# Frames that are decoded and dropped rather than seeking, which decodes from a keyframe of the
# video.
_NEAR = 8


class RecordedImages:
    """Recorded images by camera and frame, from the capture in `folder` or, where it is None, the
    one of the fit.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._capture: Capture | None = None
        self._view = -1
        self._next = 0
        self._images: Iterator[np.ndarray | Exception] = iter(())
        self._lock = Lock()

    def are_present(self, stream: FrameSource) -> bool:
        """Return whether the folder of the capture is there."""
        try:
            return Path(self._folder or fitted_capture(stream)).is_dir()
        except (OSError, ValueError):
            return False

    def at(self, stream: FrameSource, view: int, frame: int) -> np.ndarray:
        """Return the image [H, W, 3] of a camera at a frame, undistorted as for the fit.

        Raises:
            OSError, ValueError: the capture is missing, broken, or not the one of the stream; or
                the image was not recorded.
        """
        last = max(stream.frame_numbers(), default=-1)
        if view >= len(stream.cameras) or frame > last:
            raise ValueError(
                f"{stream.path}: expected a camera and a frame of the stream, got {view} and "
                f"{frame}."
            )
        with self._lock:
            # The capture of a live fit grows.
            if self._capture is None or frame >= self._capture.num_frames:
                frames = list(range(max(num_frames(stream), last + 1)))
                self._capture = open_stream_capture(stream, self._folder, frames).displayed()
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
