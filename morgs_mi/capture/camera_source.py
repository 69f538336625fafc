"""From what a camera has recorded to what a pinhole camera on the common clock would have."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from morgs_mi.capture.color_correction import ColorCorrection
from morgs_mi.capture.lens import Lens, Undistortion
from morgs_mi.core.camera import Camera
from morgs_mi.io.video import FrameReader, ImageOrError

__all__ = ["CameraSource", "at_clip_size"]


@dataclass(frozen=True)
class CameraSource:
    """One camera's clip, and what is done to its pictures.

    Attributes:
        reader: of the clip.
        lens: that it was recorded through.
        undo: what undoes the lens; None for nothing.
        picks: the clip's frames that show the instants 0, 1, ... of the recording, int [T].
        tone: what corrects the colours; None for nothing.
    """

    reader: FrameReader
    lens: Lens
    undo: Undistortion | None
    picks: np.ndarray
    tone: ColorCorrection | None = None

    def pictures(self, camera: Camera, start: int, stop: int) -> Iterator[ImageOrError]:
        """Yield what `camera` would have seen at the instants start..stop-1, an error in place of what is missing."""
        for picture in self.reader.pick(self.picks[start:stop].tolist()):
            yield self.seen(picture, camera) if isinstance(picture, np.ndarray) else picture

    def seen(self, image: np.ndarray, camera: Camera) -> np.ndarray:
        """Return a recorded picture as `camera` would have taken it."""
        image = _shrunk(self.undo(image) if self.undo else image, camera)
        return self.tone(image) if self.tone else image

    def mask(self, camera: Camera) -> np.ndarray | None:
        """Return where `camera` sees what was recorded [H, W] bool, None for everywhere."""
        if self.undo is None or self.undo.mask.all():
            return None
        # A shrunk pixel is valid if all that it averages is.
        return _shrunk(self.undo.mask.astype(np.float32), camera) > 1 - 1e-4


def at_clip_size(camera: Camera, reader: FrameReader) -> Camera:
    """Return the camera at the size of its clip, which may be the calibrated one made smaller or larger.

    Raises:
        ValueError: it is neither.
    """
    if (reader.width, reader.height) == (camera.width, camera.height):
        return camera
    x, y = reader.width / camera.width, reader.height / camera.height
    # Both sides were rounded to whole pixels.
    if abs(camera.width * y - reader.width) > 1 or abs(camera.height * x - reader.height) > 1:
        raise ValueError(
            f"{reader.path}: expected {camera.width}x{camera.height} as the calibration of {camera.name} says, or "
            f"that scaled, got {reader.width}x{reader.height}; calibrate at the recorded size."
        )
    return camera.resized(reader.width, reader.height)


def _shrunk(image: np.ndarray, camera: Camera) -> np.ndarray:
    if image.shape[:2] == (camera.height, camera.width):
        return image
    return cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
