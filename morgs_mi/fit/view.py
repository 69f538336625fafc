"""A view of the first frame: a camera, its image, and the pixels of it that count."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.losses.ssim import Target

__all__ = ["View"]


class View(NamedTuple):
    """A camera and its image.

    Attributes:
        camera: the camera.
        image: [H, W, 3], uint8.
        mask: valid pixels [H, W] bool, or None if all are.
    """

    camera: Camera
    image: np.ndarray
    mask: np.ndarray | None = None

    @property
    def target(self) -> Target:
        """The image as a fit compares with it."""
        return Target(self.image, self.mask)
