"""The transpose of blending: what the pixels of a picture are worth to each Gaussian."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.capture.camera import Camera
from morgs_mi.gaussians.gaussians import ActivatedGaussians
from morgs_mi.render.blocks import build_lists
from morgs_mi.render.compositing import Channel, Layout, blend
from morgs_mi.render.config import RenderConfig
from morgs_mi.render.projection import project
from morgs_mi.render.region import whole_view

__all__ = ["backproject"]


def backproject(
    gaussians: ActivatedGaussians, camera: Camera, picture: np.ndarray, config: RenderConfig | None = None
) -> np.ndarray:
    """Return sum_x w_i(x) picture(x) for every Gaussian i, with the weights w_i = T_i alpha_i of eq. 1.

    It is one pass of the renderer's own channel adjoint, fed with the picture as if it were a gradient.

    Args:
        gaussians: N > 0 Gaussians.
        camera: the view.
        picture: [H, W, C].
        config: cut-offs.

    Returns:
        float32 [N, C].

    Raises:
        ValueError: the picture has another size than the camera.
    """
    H, W, C = picture.shape
    if (camera.width, camera.height) != (W, H):
        raise ValueError(f"backproject(): `picture` must be {camera.height}x{camera.width}, got {H}x{W}.")
    config = config or RenderConfig()
    with dr.suspend_grad():
        splats = project(gaussians, camera, (), config)
        region = whole_view(W, H, config)
        columns = [dr.zeros(mi.Float, len(splats)) for _ in range(C)]
        lists = build_lists(splats, columns, region, config)
    dr.enable_grad(columns)
    layout = Layout((Channel(C, False),), False, False, config)
    (blended,) = blend(splats.shape, [tuple(columns)], region, lists, layout)
    dr.set_grad(blended, mi.Float(np.ascontiguousarray(picture, np.float32).ravel()))
    dr.enqueue(dr.ADMode.Backward, blended)
    dr.traverse(dr.ADMode.Backward)
    grads: list[Any] = [dr.grad(column) for column in columns]
    dr.eval(grads)
    return np.stack([np.asarray(grad) for grad in grads], axis=1)
