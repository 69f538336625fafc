"""The light of a captured scene at a point, as an environment map (image-based lighting, Debevec
1998).

The Gaussians around the point are rendered into the six faces of a cube, decoded to linear light
and resampled to latitude and longitude. Display-referred video stores at most 1: brighter light is
guessed, see `light_probe`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from morgs_mi.core.arrays import from_numpy
from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import decode_traced
from morgs_mi.core.gaussians import ActivatedGaussians
from morgs_mi.core.types import SceneDict
from morgs_mi.platform.checks import check_number, numbers, require
from morgs_mi.render.rasterize import rasterize

CLIPPED = 4.0
"""Radiance of colours that the video clipped at 1: a guess of two stops above white."""

# Pixels beyond each edge of a face, for interpolation.
_MARGIN = 2
# Display-referred value above which a colour counts as clipped in part; at 1 it does entirely.
_KNEE = 0.95


def light_probe(
    gaussians: ActivatedGaussians,
    position: ArrayLike,
    height: int = 256,
    background: Sequence[float] | None = None,
    clipped: float = CLIPPED,
    near: float = 0.01,
) -> SceneDict:
    """Return the dictionary of a Mitsuba `envmap` emitter with the light that Gaussians send to a
    point.

    It represents a scene at infinity: every point gets the light at `position`. Place it in the
    middle of the object that it lights, and make one for every frame.

    Args:
        gaussians: N Gaussians with sRGB-encoded colours.
        position: the point [3], world units.
        height: rows of the map, which has twice as many columns.
        background: display-referred colour [3] behind all Gaussians; None: black.
        clipped: radiance of colours that the video clipped at 1. The default of two stops above
            white is a guess; 1 takes the video as it is. Between display-referred 0.95 and 1, the
            radiance rises to this.
        near: distance in world units; nearer Gaussians, such as Gaussians inside the object, are
            left out.

    Example:
        >>> integrator = {"type": "gaussian_splat", "surfaces": {"type": "path"}}
        >>> scene = mi.load_dict({"type": "scene", "gaussians": morgs_mi.ellipsoids(gaussians),
        ...                       "light": morgs_mi.light_probe(gaussians, (0, 1, 0)), "ball": ball,
        ...                       "sensor": camera.sensor(), "integrator": integrator})

    Raises:
        ValueError: a position that is not [3] and finite, and numbers out of range.
    """
    place = "light_probe()"
    check_number(place, "height", height, "[4, 8192]")
    check_number(place, "clipped", clipped, "[1, inf)")
    center = check_point(place, "position", position)
    directions = _directions(int(height))
    axis = np.abs(directions).argmax(-1)
    largest = np.take_along_axis(directions, axis[..., None], axis=-1)[..., 0]
    # A face has as many pixels per degree as the map.
    size = max(int(height) // 2, 4)
    width = size + 2 * _MARGIN
    fov = np.rad2deg(2 * np.arctan(width / size))
    color = np.zeros((*directions.shape[:2], 3), np.float32)
    for k, sign in product(range(3), (1, -1)):
        up = np.eye(3)[2 if k == 1 else 1]
        camera = Camera.look_at(center, center + sign * np.eye(3)[k], up, fov, width, width)
        camera = replace(camera, near=near)
        image = np.asarray(rasterize(gaussians, camera, ("color",), background).color)
        on_face = ((axis == k) & (sign * largest > 0))[..., None]
        # What other faces show may be behind this camera.
        seen_directions = np.where(on_face, directions, camera.rotation[2])
        pixels, _ = camera.project(camera.position + seen_directions)
        places = pixels.astype(np.float32) - 0.5
        face = cv2.remap(image, places[..., 0], places[..., 1], cv2.INTER_LINEAR)
        color = np.where(on_face, face, color)
    light = radiance(dr.unravel(mi.Color3f, from_numpy(mi.Float, color)), clipped)
    return {"type": "envmap", "bitmap": mi.Bitmap(np.array(light).T.reshape(directions.shape))}


def check_point(place: str, name: str, point: ArrayLike) -> np.ndarray:
    """Return an argument as a finite point [3]; anything else raises `ValueError`."""
    point = numbers(place, name, point).astype(np.float64)
    is_point = point.shape == (3,) and np.isfinite(point).all()
    require(is_point, place, f"`{name}` must be [3] and finite", point.tolist(), "pass x, y and z")
    return point


def _directions(height: int) -> np.ndarray:
    """Return the directions [H, 2 H, 3] of the texels of an `envmap`; its first and last rows are
    the poles.
    """
    theta = np.pi * np.arange(height)[:, None] / (height - 1)
    phi = 2 * np.pi * (np.arange(2 * height) + 0.5) / (2 * height)
    x = np.sin(theta) * np.sin(phi)
    z = -np.sin(theta) * np.cos(phi)
    return np.stack([x, np.broadcast_to(np.cos(theta), x.shape), z], axis=-1)


def radiance(color: Any, clipped: float, srgb: bool = True) -> Any:
    """Return the linear light of display-referred colours (`mi.Color3f` [M]); clipped colours get
    up to `clipped`.

    Args:
        color: blended colours of Gaussians.
        clipped: radiance of colours that were clipped at 1; between display-referred 0.95 and 1, it
            rises to this.
        srgb: whether the colours are sRGB-encoded; others are linear light already, and were not
            clipped.
    """
    if not srgb:
        return color
    position = dr.clip((dr.max(color) - _KNEE) / (1 - _KNEE), 0, 1)
    return decode_traced(color) * (1 + (clipped - 1) * dr.square(position) * (3 - 2 * position))
