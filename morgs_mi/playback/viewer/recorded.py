"""Recorded images beside the render: random access to them, and how they look from the page."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.core.camera import Camera
from morgs_mi.playback.player import fitted_capture, num_frames, open_stream_capture
from morgs_mi.playback.viewer.frame_cache import FrameCache
from morgs_mi.playback.visualise import label

__all__ = ["RecordedClip", "RecordedImages", "seen_from", "wipe"]

_OUTSIDE = (40, 40, 40)
# Frames that are decoded and dropped rather than seeking, which decodes from a keyframe of the video.
_NEAR = 8


class RecordedImages:
    """Images of a capture by camera and frame; successive frames of one camera are decoded in order.

    Args:
        capture: the recording.

    Attributes:
        num_frames: number of its frames.
    """

    def __init__(self, capture: Capture) -> None:
        self.num_frames = capture.num_frames
        self._capture = capture
        self._view, self._next = -1, 0
        self._images: Iterator[np.ndarray | Exception] = iter(())
        self._last: np.ndarray | None = None

    def at(self, view: int, frame: int) -> np.ndarray | None:
        """Return the image [H, W, 3] of a camera at a frame, None if it was not recorded.

        Raises:
            OSError, ValueError: the file is missing or broken.
        """
        if view == self._view and frame == self._next - 1:
            return self._last
        if view != self._view or not self._next <= frame < self._next + _NEAR:
            self._images, self._view, self._next = self._capture.images(view, frame), view, frame
        image: np.ndarray | Exception | None = None
        for _ in range(self._next, frame + 1):
            image = next(self._images, None)
        self._next, self._last = frame + 1, image if isinstance(image, np.ndarray) else None
        return self._last


class RecordedClip:
    """Recorded images of a stream; its capture is opened when the first one is shown.

    Args:
        cache: frames of the stream.
        folder: folder of the capture; None: the one that was fitted.
    """

    def __init__(self, cache: FrameCache, folder: Path | None) -> None:
        self._cache, self._folder = cache, folder
        self._images: RecordedImages | None = None

    def problem(self) -> str | None:
        """Return why there are no recorded images, without opening the capture; None if there are."""
        try:
            path = Path(self._folder or fitted_capture(self._cache.stream))
        except (OSError, ValueError) as error:
            return str(error)
        return None if path.is_dir() else f"{path}: expected the capture, found none; pass its folder (--capture)."

    def at(self, view: int, frame: int) -> np.ndarray | None:
        """Return the image [H, W, 3] of a camera at a frame; None if it was not recorded.

        Raises:
            OSError, ValueError: the capture is missing, broken, or not the one of the stream.
        """
        if self._images is None or frame >= self._images.num_frames:  # the capture of a live fit grows
            stream = self._cache.stream
            count = max(num_frames(stream), self._cache.frames[-1] + 1)
            self._images = RecordedImages(open_stream_capture(stream, self._folder, list(range(count))))
        return self._images.at(view, frame)


def seen_from(view: Camera, camera: Camera, image: np.ndarray) -> np.ndarray:
    """Return a camera's image [h, w, 3] as a view at the same position sees it [H, W, 3]; dark grey beyond its edges.

    The two image planes differ by a homography, whatever the directions and intrinsics.
    """
    shrink = min(1.0, view.K[0, 0] / camera.K[0, 0])  # by area, because the warp takes only the nearest four pixels
    size = tuple(max(1, round(shrink * side)) for side in (camera.width, camera.height))
    image, camera = cv2.resize(image, size, interpolation=cv2.INTER_AREA), camera.resized(*size)
    R = np.asarray(view.viewmat)[:3, :3] @ np.asarray(camera.viewmat)[:3, :3].T
    corner = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # OpenCV has the first pixel's centre at 0
    homography = np.linalg.inv(corner) @ view.K @ R @ np.linalg.inv(camera.K) @ corner
    return cv2.warpPerspective(image, homography, (view.width, view.height), borderValue=_OUTSIDE)


def wipe(recorded: np.ndarray, rendered: np.ndarray, share: float) -> np.ndarray:
    """Return an image [H, W, 3] with the recorded image in a share of the width at the left, and labels."""
    column = round(share * rendered.shape[1])
    image = rendered.copy()
    if column < rendered.shape[1]:
        image[:, column:] = label(rendered[:, column:], "rendered")
    if column > 0:
        image[:, :column] = label(recorded[:, :column], "recorded")
        image[:, max(column - 1, 0) : column + 1] = 255
    return image
