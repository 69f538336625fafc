"""Back-projection, the transpose of blending: sums of an image's pixels per Gaussian, by blend weight."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import ActivatedGaussians
from morgs_mi.core.memory import from_numpy
from morgs_mi.render.blocks import build_lists, touches
from morgs_mi.render.compositing import Channel, Layout, padded, weighted_sums
from morgs_mi.render.kernel_recording import with_render_lock
from morgs_mi.render.projection import Splats, project
from morgs_mi.render.region import Region, full_view
from morgs_mi.render.render_config import RenderConfig

__all__ = ["backproject"]


@with_render_lock
def backproject(
    gaussians: ActivatedGaussians,
    camera: Camera,
    image: np.ndarray,
    config: RenderConfig | None = None,
    region: Region | None = None,
    static_splats: Splats | None = None,
) -> np.ndarray:
    """Return sum_x w_i(x) image(x) for every Gaussian i, with the weights w_i = T_i alpha_i of eq. 1.

    This is one pass of the renderer's channel adjoint with the image in place of a gradient.

    Args:
        gaussians: N Gaussians.
        camera: the view.
        image: [H, W, C], or on the region.
        config: cut-offs.
        region: the pixels that are summed over; None: the whole view.
        static_splats: splats of this view that are blended with the Gaussians and receive no sum.

    Returns:
        float32 [N, C].

    Raises:
        ValueError: the size of the image does not match the camera or the region.
    """
    config, C = config or RenderConfig(), (np.shape(image) or (0,))[-1]
    region = region or full_view(camera.width, camera.height, config)
    if not C or image.shape != region.shape(C):
        size = ", ".join(map(str, region.shape(C)[:-1]))
        raise ValueError(
            f"backproject(): `image` must be [{size}, C] with C > 0, got {list(np.shape(image))}; resize it to the "
            "camera, or crop it to the region."
        )
    sums = np.zeros((int(gaussians.means.shape[0]), C), np.float32)
    if not len(sums):
        return sums
    with dr.suspend_grad():
        # Lists of Gaussians that do not touch the region would take more time than the rest.
        rows = dr.compress(touches(project(gaussians, camera, (), config), region))
        N = dr.width(rows)
        if not N:
            return sums
        splats = project(gaussians, camera, (), config, rows)
        if static_splats is not None:
            splats = splats.concatenated_with(static_splats)
        columns = [dr.zeros(mi.Float, len(splats)) for _ in range(C)]
        lists = build_lists(splats, columns, region, config)
        layout = Layout((Channel(C, False),), False, False, config)
        grads = weighted_sums([padded(from_numpy(mi.Float, image), region, C)], region, lists, layout)
        dr.eval(grads)
    sums[np.asarray(rows)] = np.stack([np.asarray(grad)[:N] for grad in grads], axis=1)
    return sums
