"""PNG and JPEG files in memory."""

from __future__ import annotations

import cv2
import numpy as np


def png_bytes(image: np.ndarray) -> bytes:
    """Return an image, uint8 RGB [H, W, 3] or RGBA [H, W, 4], as a PNG file."""
    order = cv2.COLOR_RGB2BGR if image.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
    return cv2.imencode(".png", cv2.cvtColor(image, order))[1].tobytes()


def jpeg_bytes(image: np.ndarray) -> bytes:
    """Return an image, uint8 RGB [H, W, 3], as a JPEG file."""
    return cv2.imencode(".jpg", image[..., ::-1])[1].tobytes()
