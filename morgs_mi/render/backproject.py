"""The transpose of blending: what the pixels of a picture are worth to each Gaussian."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import ActivatedGaussians
from morgs_mi.render.blocks import build_lists
from morgs_mi.render.compositing import Channel, Layout, blend
from morgs_mi.render.config import RenderConfig
from morgs_mi.render.projection import Splats, project
from morgs_mi.render.region import Region, full_view

__all__ = ["backproject"]


def backproject(
    gaussians: ActivatedGaussians,
    camera: Camera,
    picture: np.ndarray,
    config: RenderConfig | None = None,
    region: Region | None = None,
    static_splats: Splats | None = None,
) -> np.ndarray:
    """Return sum_x w_i(x) picture(x) for every Gaussian i, with the weights w_i = T_i alpha_i of eq. 1.

    It is one pass of the renderer's own channel adjoint, fed with the picture as if it were a gradient.

    Args:
        gaussians: N > 0 Gaussians.
        camera: the view.
        picture: [H, W, C], or on the region.
        config: cut-offs.
        region: the pixels that are summed over; None: the whole view.
        static_splats: splats of this view that stand among the Gaussians and take their share.

    Returns:
        float32 [N, C].

    Raises:
        ValueError: the picture has another size than the camera or the region.
    """
    config, C = config or RenderConfig(), picture.shape[-1]
    region = region or full_view(camera.width, camera.height, config)
    if picture.shape != region.shape(C):
        raise ValueError(f"backproject(): `picture` must be {list(region.shape(C))}, got {list(picture.shape)}.")
    with dr.suspend_grad():
        splats = project(gaussians, camera, (), config)
        N = len(splats)
        if static_splats is not None:
            splats = splats.concatenated_with(static_splats, None)
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
    return np.stack([np.asarray(grad)[:N] for grad in grads], axis=1)
