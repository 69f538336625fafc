"""The part of every pixel that each surface, and the splats together, contribute to an image."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import ActivatedGaussians
from morgs_mi.plugins.surface_view import coverage_and_depth
from morgs_mi.render.rasterize import rasterize

__all__ = ["SPLATS", "mattes"]

SPLATS = "splats"
"""Name of the matte of all Gaussians."""


def mattes(gaussians: ActivatedGaussians, camera: Camera, scene: Any) -> dict[str, np.ndarray]:
    """Return the weight in [0, 1] of every surface and of the splats in each pixel, float32 [H, W] by name.

    The weight of a surface is the fraction of the pixel that it covers, times the transmittance of the splats in front.
    The rest is the background. The names are the shapes' names in the scene; shapes of one name share a matte.

    Args:
        gaussians: N Gaussians.
        camera: the view.
        scene: Mitsuba scene with the surfaces.
    """
    size, crop, sensor = (
        (camera.height, camera.width),
        (0, 0, camera.width, camera.height),
        mi.load_dict(camera.sensor()),
    )
    with dr.suspend_grad():
        shapes = [shape for shape in scene.shapes() if not shape.is_ellipsoids()]
        covered, depth = (np.array(v).reshape(size) for v in coverage_and_depth(scene, sensor, camera, crop))
        whole = np.asarray(rasterize(gaussians, camera, ("alpha",)).alpha)[..., 0]
        front = np.asarray(rasterize(gaussians, camera, ("alpha",), depth_limit=depth).alpha)[..., 0]
        result = {SPLATS: covered * front + (1 - covered) * whole}
        for shape in shapes:
            part = np.array(coverage_and_depth(scene, sensor, camera, crop, shape)[0]).reshape(size) * (1 - front)
            result[shape.id()] = result.get(shape.id(), 0) + part
    return {name: part.astype(np.float32) for name, part in result.items()}
