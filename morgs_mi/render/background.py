"""What is behind all Gaussians: a colour, or an image of a camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.arrays import from_numpy
from morgs_mi.core.camera import Camera
from morgs_mi.core.types import Float, Jit
from morgs_mi.render.render_config import RenderConfig


def backdrops(cameras: Sequence[Camera], config: RenderConfig) -> list[np.ndarray] | None:
    """Return the image behind all Gaussians for each camera [H, W, 3]; None if no camera has one:
    it is the colour of `config`.
    """
    images = [camera.backdrop for camera in cameras]
    if all(image is None for image in images):
        return None
    plain = np.zeros((cameras[0].height, cameras[0].width, 3), np.float32)
    plain += config.background or (0, 0, 0)
    return [plain if image is None else image for image in images]


def over(background: Sequence[float] | Jit | None, values: Float, weight: Float) -> Float:
    """Return flat colours with the sums of their weights, composited over the background."""
    color: Any = background
    if dr.is_jit_v(color):
        behind = mi.Float(color.array if dr.is_tensor_v(color) else dr.ravel(color))
    else:
        behind = from_numpy(mi.Float, np.asarray(color, np.float32).ravel())
    if dr.width(behind) == dr.width(values):
        return dr.fma(1 - weight, behind, values)
    # Numbers of their own: the gradient of one array would be added by all pixels to three places.
    one = dr.gather(mi.Color3f, behind, mi.UInt32(0))
    component = dr.arange(mi.UInt32, dr.width(weight)) % 3
    return dr.fma(
        1 - weight,
        dr.select(component == 0, one.x, dr.select(component == 1, one.y, one.z)),
        values,
    )
